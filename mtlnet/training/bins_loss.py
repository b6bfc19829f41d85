"""The loss of a network that answers in bins (`mtlnet.model.bins`).

Distances: the cross-entropy of each one's target distribution, mean over the five and the batch:
summed, as the paper's squared errors are, they left the angle and the class behind in a pilot of
300 steps. Angle: the cross-entropy and, beside it, the error of the distribution's mean in bins
(Huber), as Ruiz et al. 2018 do for head pose: a softmax over bins does not know which are
neighbours. Class: the cross-entropy. Alpha weighs the three tasks as in the paper.
"""

from collections.abc import Callable

import torch
from torch import Tensor
from torch.nn.functional import smooth_l1_loss

from mtlnet.model.bins import Scores, bin_targets, read_scores, soft_cross_entropy
from mtlnet.training.loss import Alpha, Losses, heading_loss, known_targets, weighted_sum
from trackfeatures.coding import OFFSET


def bins_loss(
    scores: Scores,
    coded: Tensor,
    heading: Tensor,
    combine: Alpha | Callable[[Tensor], Tensor],
    auxiliary: Tensor | None = None,
) -> Losses:
    """Losses of scores for targets coded (B, 6) and heading (B,); `auxiliary` joins their sum.

    Reported are the squared errors of the coded answers, as of any other network. A label that is
    unknown has no loss, as in `mtlnet.training.loss`.
    """
    known, weight = known_targets(coded)
    distances, angles = bin_targets(torch.where(known, coded, OFFSET))
    crosses = torch.where(known[:, :5], soft_cross_entropy(scores.distance, distances), 0.0)
    terms = (
        (crosses * weight).mean(),
        soft_cross_entropy(scores.angle, angles).mean() + mean_error(scores.angle, angles),
        heading_loss(scores.heading, heading),
    )
    total = weighted_sum(terms, combine)
    with torch.no_grad():
        answers = read_scores(scores.distance, scores.angle)
        squared = torch.where(known, answers - coded, 0.0) ** 2
    kept = torch.stack(terms).detach()
    return Losses(
        distance=(squared[:, :5] * weight).sum(1).mean(),
        angle=squared[:, 5].mean(),
        heading=kept[2],
        total=total if auxiliary is None else total + auxiliary,
        terms=kept,
    )


def mean_error(scores: Tensor, targets: Tensor) -> Tensor:
    """The Huber loss, in bins, of the means of B distributions: scores and targets (B, bins)."""
    number = torch.arange(scores.shape[1], dtype=torch.float32, device=scores.device)
    return smooth_l1_loss(torch.softmax(scores, 1) @ number, targets @ number)
