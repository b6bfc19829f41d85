"""The multi-task loss (paper, equations 6 to 9): three weighted terms.

Distance: squared error, summed over the five coded distances and averaged over the batch. Angle:
squared error of the coded angle, averaged over the batch. Class (the paper's "type"): cross-entropy
of the class, averaged over the batch. The optimizer adds the L2 term lambda |w|^2 of the weights w,
as a weight decay of 2 lambda, because the gradient of this term is 2 lambda w.

An unknown label (a coded target of NaN, the class `UNKNOWN_HEADING`) has no loss: means are over
the known labels.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import cross_entropy, smooth_l1_loss

from mtlnet.training.recipes import HuberLoss
from trackfeatures.road_class import UNKNOWN_HEADING

Terms = Sequence[Tensor]
"""Loss terms () of the tasks, in the order of `TASKS`, before their weights."""


@dataclass(frozen=True)
class Losses:
    """The losses of a batch; each is a scalar tensor, except `terms`.

    `distance` and `angle`: squared errors of the coded values. `heading`: cross-entropy of the
    class. `total`: the weighted sum that training minimises. `terms` (3,): the tasks' terms of this
    sum before their weights; they can have other units than the first three losses.
    """

    distance: Tensor
    angle: Tensor
    heading: Tensor
    total: Tensor
    terms: Tensor

    def row(self) -> Tensor:
        """Return distance, angle, class and total loss (4,), detached."""
        return torch.stack([self.distance, self.angle, self.heading, self.total.detach()])


def multi_task_loss(
    outputs: Tensor,
    coded: Tensor,
    heading: Tensor,
    total: Callable[[Terms], Tensor],
    target_variance: Tensor | None = None,
    huber: HuberLoss | None = None,
) -> Losses:
    """Compute the losses of `outputs` (B, 9) for the targets `coded` (B, 6) and `heading` (B,)
    int64.

    `total`: computes the sum that training minimises from the tasks' terms (`TaskWeighting.total`).
    `target_variance` (6,): variances of the coded targets. With it, the terms
    (not the reported losses) are in units of these variances and averaged over the distances, so
    that a network that predicts the mean has a loss of about 1 in every task. `huber`: replaces the
    squared errors by Huber losses; it is used only with `target_variance`.
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
    detached = torch.stack(terms).detach()
    return Losses(distance.detach(), angle.detach(), cross.detach(), total(terms), detached)


def known_targets(coded: Tensor) -> tuple[Tensor, Tensor]:
    """Return the mask (B, 6) of the coded targets that are not NaN, and the factor, a scalar, that
    turns a mean over all distances into a mean over the known distances (1 if all are known)."""
    known = ~coded.isnan()
    each = known[:, :5]
    return known, each.numel() / each.sum().clamp_min(1)


def heading_loss(scores: Tensor, heading: Tensor) -> Tensor:
    """Compute the cross-entropy of scores (B, 3) for classes (B,), mean over the known classes; 0
    if no class is known."""
    total = cross_entropy(scores, heading, ignore_index=UNKNOWN_HEADING, reduction="sum")
    return total / (heading != UNKNOWN_HEADING).sum().clamp_min(1)


def _huber(errors: Tensor, target_variance: Tensor, huber: HuberLoss) -> Tensor:
    deviations = errors * target_variance.rsqrt()
    zero = torch.zeros_like(deviations)
    distances = smooth_l1_loss(
        deviations[:, :5], zero[:, :5], reduction="none", beta=huber.distance_beta
    )
    angle = smooth_l1_loss(deviations[:, 5:], zero[:, 5:], reduction="none", beta=huber.angle_beta)
    return torch.cat([huber.distance_gain * distances, huber.angle_gain * angle], 1)
