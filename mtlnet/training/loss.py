"""The multi-task loss (paper, equations 6 to 9): three tasks weighted by alpha.

Distance: squared error, summed over the five coded distances, mean over the batch. Angle: squared
error of the coded angle, mean over the batch. Class (the paper's "type"): cross-entropy of the
class, mean over the batch. The L2 term is part of the optimizer: a weight decay of 2 lambda is the
gradient of lambda |w|^2.

A label that is unknown (a coded target of NaN, the class `UNKNOWN_HEADING`) has no loss: means are
over the known ones.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import cross_entropy, smooth_l1_loss

from trackfeatures.definitions import UNKNOWN_HEADING
from trackfeatures.errors import UserError

TASKS = ("distance", "angle", "heading")
Alpha = tuple[float, float, float]


class AlphaError(UserError):
    """Task weights that are missing, negative, not numbers, or all zero."""


@dataclass(frozen=True)
class HuberLoss:
    """The Huber loss (Huber 1964) of errors in standard deviations of their targets, and gains.

    An error is squared up to `distance_beta` or `angle_beta` standard deviations and linear beyond.
    Where a distance has two possible values, the best prediction is then the likelier one; a
    squared error asks for a value in between. The angle does not jump: its beta is large.

    The gains multiply the terms of distance and angle. Without them the cross-entropy of the
    heading, which stays large, outweighs both: distances are learned far better with them, and
    nothing is learned worse (docs/experiments/task-weights.md).
    """

    distance_beta: float
    angle_beta: float = 1.0
    distance_gain: float = 2.5
    angle_gain: float = 5.0


@dataclass(frozen=True)
class Losses:
    """The unweighted loss of each task, as reported, and the sum that is minimised.

    `terms` (3,): the term of each task in that sum, before its weight.
    """

    distance: Tensor
    angle: Tensor
    heading: Tensor
    total: Tensor
    terms: Tensor

    def row(self) -> Tensor:
        """Distance, angle, heading, total (4,), without the graph."""
        return torch.stack([self.distance, self.angle, self.heading, self.total.detach()])


def parse_alpha(text: str) -> Alpha:
    """Three weights given as "distance,angle,heading": not negative, of any sum; 0 omits a task.

    Raises AlphaError.
    """
    parts = [part.strip() for part in text.split(",")]
    how = "give three weights for distance, angle and heading, such as --alpha 0.3,0.2,0.5"
    if len(parts) != len(TASKS):
        raise AlphaError(f"alpha has {len(parts)} weight(s) ({text!r}); {how}")
    try:
        distance, angle, heading = (float(part) for part in parts)
    except ValueError:
        raise AlphaError(
            f"alpha {text!r} has a weight that is missing or no number; {how}"
        ) from None
    for task, weight in zip(TASKS, (distance, angle, heading), strict=True):
        if not math.isfinite(weight) or weight < 0:
            raise AlphaError(
                f"alpha's weight for {task} is {weight:g}; it must be 0 or more; {how}"
            )
    if distance == angle == heading == 0:
        raise AlphaError(f"alpha {text!r} leaves nothing to learn; give at least one task a weight")
    return distance, angle, heading


def multi_task_loss(
    outputs: Tensor,
    coded: Tensor,
    heading: Tensor,
    combine: Alpha | Callable[[Tensor], Tensor],
    target_variance: Tensor | None = None,
    huber: HuberLoss | None = None,
) -> Losses:
    """Losses of outputs (B, 9) for targets coded (B, 6) and heading (B,) int64.

    `combine`: the weights of the tasks, or a function from their terms (3,) to the sum to minimise.
    `target_variance` (6,): variances of the coded targets. With it the sum that is minimised (never
    the reported losses) has squared errors in units of them, and the mean over the distances: a
    task then costs about 1 when its mean is predicted, whatever its range. `huber`: with
    `target_variance`, Huber losses in place of squares.
    """
    known, weight = known_targets(coded)
    errors = torch.where(known, outputs[:, :6].float() - coded, 0.0)
    squared = errors**2
    distance = (squared[:, :5] * weight).sum(1).mean()
    angle = squared[:, 5].mean()
    cross = heading_loss(outputs[:, 6:].float(), heading)
    if target_variance is None:
        terms = (distance, angle, cross)
    else:
        scaled = (
            squared / target_variance if huber is None else _huber(errors, target_variance, huber)
        )
        terms = ((scaled[:, :5] * weight).mean(), scaled[:, 5].mean(), cross)
    total = weighted_sum(terms, combine)
    detached = torch.stack(terms).detach()
    return Losses(distance.detach(), angle.detach(), cross.detach(), total, detached)


def known_targets(coded: Tensor) -> tuple[Tensor, Tensor]:
    """Which coded targets (B, 6) are known, and the weight () by which the mean over all distances
    becomes that over the known ones: 1 where all are."""
    known = ~coded.isnan()
    each = known[:, :5]
    return known, each.numel() / each.sum().clamp_min(1)


def heading_loss(scores: Tensor, heading: Tensor) -> Tensor:
    """Cross-entropy of scores (B, 3) for classes (B,), mean over the known ones; 0 without any."""
    total = cross_entropy(scores, heading, ignore_index=UNKNOWN_HEADING, reduction="sum")
    return total / (heading != UNKNOWN_HEADING).sum().clamp_min(1)


def weighted_sum(
    terms: tuple[Tensor, Tensor, Tensor], combine: Alpha | Callable[[Tensor], Tensor]
) -> Tensor:
    """The sum to minimise of the tasks' terms, by weights or by a function of the terms (3,)."""
    if callable(combine):
        return combine(torch.stack(terms))
    # A weight of 0 takes the task out of the graph: a true single-task network.
    weighted = [weight * term for weight, term in zip(combine, terms, strict=True) if weight]
    return torch.stack(weighted).sum()


def _huber(errors: Tensor, target_variance: Tensor, huber: HuberLoss) -> Tensor:
    deviations = errors * target_variance.rsqrt()
    zero = torch.zeros_like(deviations)
    distances = smooth_l1_loss(
        deviations[:, :5], zero[:, :5], reduction="none", beta=huber.distance_beta
    )
    angle = smooth_l1_loss(deviations[:, 5:], zero[:, 5:], reduction="none", beta=huber.angle_beta)
    return torch.cat([huber.distance_gain * distances, huber.angle_gain * angle], 1)
