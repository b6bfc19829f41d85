"""The multi-task loss (paper, equations 6 to 9): three tasks weighted by alpha.

Distances: squared error, summed over the five coded distances, mean over the batch. Angle: squared
error of the coded angle, mean over the batch. Type: cross-entropy of the class, mean over the
batch. The L2 term is the optimiser's: a weight decay of 2 lambda is the gradient of lambda |w|^2.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import cross_entropy, smooth_l1_loss

from trackfeatures.errors import UserError

TASKS = ("distance", "angle", "type")
Alpha = tuple[float, float, float]
ANGLE_BEND, ANGLE_GAIN = 1.0, 5.0
DISTANCE_GAIN = 2.5


class AlphaError(UserError):
    """Task weights that are no task weights."""


@dataclass(frozen=True)
class Losses:
    """The unweighted loss of each task, as reported, and the sum that is minimised.

    `terms` (3,): what that sum weighs, of each task.
    """

    distance: Tensor
    angle: Tensor
    type: Tensor
    total: Tensor
    terms: Tensor

    def row(self) -> Tensor:
        """Distance, angle, type, total (4,), without the graph."""
        return torch.stack([self.distance, self.angle, self.type, self.total.detach()])


def parse_alpha(text: str) -> Alpha:
    """Three weights "distance,angle,type", non-negative, of any sum; 0 leaves a task out.

    Raises AlphaError naming what was seen.
    """
    parts = [part.strip() for part in text.split(",")]
    how = "give three weights for distance, angle and type, such as --alpha 0.3,0.2,0.5"
    if len(parts) != len(TASKS):
        raise AlphaError(f"alpha has {len(parts)} weight(s) ({text!r}); {how}")
    try:
        distance, angle, kind = (float(part) for part in parts)
    except ValueError:
        raise AlphaError(
            f"alpha {text!r} has a weight that is missing or no number; {how}"
        ) from None
    for task, weight in zip(TASKS, (distance, angle, kind), strict=True):
        if not math.isfinite(weight) or weight < 0:
            raise AlphaError(
                f"alpha's weight for {task} is {weight:g}; it must be 0 or more; {how}"
            )
    if distance == angle == kind == 0:
        raise AlphaError(f"alpha {text!r} leaves nothing to learn; give at least one task a weight")
    return distance, angle, kind


def multi_task_loss(
    outputs: Tensor,
    coded: Tensor,
    heading: Tensor,
    combine: Alpha | Callable[[Tensor], Tensor],
    scale: Tensor | None = None,
    bend: float = 0.0,
) -> Losses:
    """Losses of outputs (B, 9) for targets coded (B, 6) and heading (B,) int64.

    `combine`: the tasks' weights, or what makes the sum to minimise out of their terms (3,).

    `scale` (6,): variances of the coded targets. With it, the sum that is minimised (never the
    reported losses) counts squared errors in units of them, distances as their mean: a task
    answered by its mean then costs about 1, whatever its range. `bend`: from so many standard
    deviations on a distance's error costs what it is, not its square (Huber 1964), 0: never.
    Between two possible answers the best is then the likelier, where a squared error asks for one
    in between. The angle never jumps: with `bend` its errors count squared up to `ANGLE_BEND`.
    With `bend` distances count `DISTANCE_GAIN` times and the angle `ANGLE_GAIN` times: what the
    paper's weights ask of coded numbers they then ask of these units, beside a class whose loss
    stays large. Distances are learned far better so, and nothing worse (EXPERIMENTS).
    """
    errors = outputs[:, :6].float() - coded
    squared = errors**2
    distance = squared[:, :5].sum(1).mean()
    angle = squared[:, 5].mean()
    kind = cross_entropy(outputs[:, 6:].float(), heading)
    if scale is None:
        terms = (distance, angle, kind)
    else:
        scaled = _bent(errors, scale, bend) if bend else squared / scale
        terms = (scaled[:, :5].mean(), scaled[:, 5].mean(), kind)
    if callable(combine):
        total = combine(torch.stack(terms))
    else:
        # A weight of 0 takes the task out of the graph: a true single-task network.
        weighted = [weight * term for weight, term in zip(combine, terms, strict=True) if weight]
        total = torch.stack(weighted).sum()
    kept = torch.stack(terms).detach()
    return Losses(distance.detach(), angle.detach(), kind.detach(), total, kept)


def _bent(errors: Tensor, scale: Tensor, bend: float) -> Tensor:
    units = errors * scale.rsqrt()
    none = torch.zeros_like(units)
    distances = smooth_l1_loss(units[:, :5], none[:, :5], reduction="none", beta=bend)
    angle = smooth_l1_loss(units[:, 5:], none[:, 5:], reduction="none", beta=ANGLE_BEND)
    return torch.cat([DISTANCE_GAIN * distances, ANGLE_GAIN * angle], 1)
