"""The loss of a network that answers in bins (`mtlnet.model.bins`).

Distances: the cross-entropy of each one's target distribution, mean over the five and the batch:
summed, as the paper's squared errors are, they left the angle and the class behind in a pilot of
300 steps. Angle and class: of one distribution each. Alpha weighs the three tasks as in the paper.
"""

from collections.abc import Callable

import torch
from torch import Tensor
from torch.nn.functional import cross_entropy

from mtlnet.model.bins import Scores, bin_targets, read_scores, soft_cross_entropy
from mtlnet.training.loss import Alpha, Losses, weighted_sum


def bins_loss(
    scores: Scores,
    coded: Tensor,
    heading: Tensor,
    combine: Alpha | Callable[[Tensor], Tensor],
    auxiliary: Tensor | None = None,
) -> Losses:
    """Losses of scores for targets coded (B, 6) and heading (B,); `auxiliary` joins their sum.

    Reported are the squared errors of the coded answers, as of any other network.
    """
    distances, angles = bin_targets(coded)
    terms = (
        soft_cross_entropy(scores.distance, distances).mean(),
        soft_cross_entropy(scores.angle, angles).mean(),
        cross_entropy(scores.heading, heading),
    )
    total = weighted_sum(terms, combine)
    with torch.no_grad():
        squared = (read_scores(scores.distance, scores.angle) - coded) ** 2
    kept = torch.stack(terms).detach()
    return Losses(
        distance=squared[:, :5].sum(1).mean(),
        angle=squared[:, 5].mean(),
        heading=kept[2],
        total=total if auxiliary is None else total + auxiliary,
        terms=kept,
    )
