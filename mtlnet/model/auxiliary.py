"""Auxiliary heads and loss of a network with heads over bins, used only in training.

The first head predicts the image columns in which the two markings of the car's lane cross ten
image rows (`ROWS`). It is a 1 x 1 convolution of the grid, with a softmax over the grid's columns
for each marking and row. The target distribution of an image column divides the probability between
the two nearest columns of the grid. The second head predicts the curvature of the road at eight
distances from 0 to 40 m in front of the car (`AHEAD_M`) from the last shared features, with a
softmax over 41 bins for each distance. The columns make the network keep small details of the
image, and the curvature makes it see where a bend begins. `mtlnet.data.road_ahead` computes the
labels; unknown labels add no loss.
"""

import torch
from torch import Tensor, nn

from mtlnet.architecture import HEIGHT, WIDTH, Architecture, grid_size
from mtlnet.model.bins import normal_targets, soft_cross_entropy

ROWS = (112.0, 116.0, 121.0, 127.0, 134.0, 143.0, 154.0, 168.0, 186.0, 206.0)
"""Image rows, px, in which a level camera sees the road 25, 16, 11, 8.4, 6.4, 4.9, 3.8, 3.0, 2.3
and 1.9 m ahead."""
SIDES = 2  # left and right marking of the lane
AHEAD_M = (0.0, 5.0, 10.0, 15.0, 20.0, 25.0, 30.0, 40.0)
LABELS = SIDES * len(ROWS) + len(AHEAD_M)
COLUMNS_WEIGHT, CURVATURE_WEIGHT = 0.5, 0.1
CURVATURES = 41  # bins of a curvature
SHARPEST = 0.32
"""Largest square root of a curvature in 1/m that the bins contain, the root for a bend of 10 m
radius. The bins have equal widths in the root."""


class AuxiliaryHeads(nn.Module):
    """The heads that predict the markings' image columns and the road's curvatures for the network
    `plan`. `size`: number of last shared features."""

    def __init__(self, plan: Architecture, size: int) -> None:
        super().__init__()
        channels, height, _ = grid_size(plan)
        self.columns = nn.Conv2d(channels, SIDES * len(ROWS), 1)
        self.curvature = nn.Linear(size, len(AHEAD_M) * CURVATURES)
        place = (HEIGHT - plan.first_row) / height
        self.rows = [min(int((row - plan.first_row) / place), height - 1) for row in ROWS]
        """Index of the grid row that contains each image row of `ROWS`."""

    def forward(self, grid: Tensor, x: Tensor) -> tuple[Tensor, Tensor]:
        """Compute scores, before the softmax, of the columns of 2 markings in 10 rows
        (B, 2, 10, w), and of 8 curvatures (B, 8, 41), from the features of the last convolution
        `grid` (B, C, h, w) and the last shared features `x` (B, F)."""
        with torch.autocast(grid.device.type, enabled=False):
            places = self.columns(grid.float())
            places = places.view(len(grid), SIDES, len(ROWS), *grid.shape[2:])
            columns = [places[:, :, number, row] for number, row in enumerate(self.rows)]
            curvature = self.curvature(x.float()).view(-1, len(AHEAD_M), CURVATURES)
            return torch.stack(columns, 2), curvature


def auxiliary_loss(scores: tuple[Tensor, Tensor], labels: Tensor) -> Tensor:
    """Compute the weighted sum of the cross-entropies of columns and curvatures, a scalar.

    `scores`: the result of `AuxiliaryHeads`. `labels` (B, 28): for each image 10 image columns in
    px of the left marking and 10 of the right, then 8 curvatures in 1/m; NaN where unknown.
    """
    columns, curvature = scores
    places = labels[:, : -len(AHEAD_M)].reshape(-1, SIDES, len(ROWS))
    bends = labels[:, -len(AHEAD_M) :]
    column = soft_cross_entropy(columns, split_columns(places, columns.shape[-1]))
    root = (bends.sign() * bends.abs().sqrt()).nan_to_num()
    bend = soft_cross_entropy(curvature, normal_targets(root, -SHARPEST, SHARPEST, CURVATURES))
    return COLUMNS_WEIGHT * _known_mean(column, places) + CURVATURE_WEIGHT * _known_mean(
        bend, bends
    )


def split_columns(places: Tensor, count: int) -> Tensor:
    """Convert image columns `places` (...) in px to target distributions (..., count) over the
    `count` columns of the grid. A distribution is divided between the two grid columns whose
    centres enclose the image column."""
    at = (places.nan_to_num() * (count / WIDTH) - 0.5).clamp(0, count - 1)
    number = torch.arange(count, dtype=at.dtype, device=at.device)
    return (1 - (at[..., None] - number).abs()).clamp_min(0)


def _known_mean(losses: Tensor, labels: Tensor) -> Tensor:
    """Mean () of the losses whose labels, of the same shape, are not NaN."""
    known = ~labels.isnan()
    return (losses * known).sum() / known.sum().clamp_min(1)
