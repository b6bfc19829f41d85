"""The loss of a network with heads over bins (`mtlnet.model.bins`).

The loss of the distances is the cross-entropy with the target distributions, averaged over the five
distances and the batch. (The paper sums its squared errors over the five distances. A sum of the
cross-entropies outweighed the losses of angle and class in a pilot of 300 steps.) The loss of the
angle is the cross-entropy plus the Huber error of the distribution's mean, in bins, as in Ruiz et
al. 2018 for head pose, because the cross-entropy alone does not depend on how far a wrong bin is
from the right bin. The loss of the class is the cross-entropy. The task weights alpha multiply the
losses of the three tasks, as in the paper.
"""

from collections.abc import Callable

import torch
from torch import Tensor
from torch.nn.functional import smooth_l1_loss

from mtlnet.model.bins import Scores, bin_targets, read_scores, soft_cross_entropy
from mtlnet.training.losses.multi_task import Losses, Terms, heading_loss, known_targets
from trackfeatures.coding import OFFSET


def bins_loss(
    scores: Scores,
    coded: Tensor,
    heading: Tensor,
    total: Callable[[Terms], Tensor],
    auxiliary: Tensor | None = None,
) -> Losses:
    """Compute the losses of `scores` of B images for the targets `coded` (B, 6) and `heading` (B,).

    `total`: function that computes the sum that training minimises from the tasks' three terms. The
    scalar `auxiliary` is added to this sum. The reported losses of distance and angle are squared
    errors of the coded answers, as for networks without bins. An unknown distance (NaN) or class
    (`UNKNOWN_HEADING`) adds no loss.
    """
    known, weight = known_targets(coded)
    distances, angles = bin_targets(torch.where(known, coded, OFFSET))
    crosses = torch.where(known[:, :5], soft_cross_entropy(scores.distance, distances), 0.0)
    terms = (
        (crosses * weight).mean(),
        soft_cross_entropy(scores.angle, angles).mean() + mean_error(scores.angle, angles),
        heading_loss(scores.heading, heading),
    )
    weighted = total(terms)
    with torch.no_grad():
        answers = read_scores(scores.distance, scores.angle)
        squared = torch.where(known, answers - coded, 0.0) ** 2
    kept = torch.stack(terms).detach()
    return Losses(
        distance=(squared[:, :5] * weight).sum(1).mean(),
        angle=squared[:, 5].mean(),
        heading=kept[2],
        total=weighted if auxiliary is None else weighted + auxiliary,
        terms=kept,
    )


def mean_error(scores: Tensor, targets: Tensor) -> Tensor:
    """Compute the Huber loss, in bins, of the differences between the means of B predicted
    distributions (`scores` before the softmax) and B target distributions, both (B, bins). Returns
    the mean over the B images, a scalar."""
    number = torch.arange(scores.shape[1], dtype=torch.float32, device=scores.device)
    return smooth_l1_loss(torch.softmax(scores, 1) @ number, targets @ number)
