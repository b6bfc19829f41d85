"""What a network that answers in bins learns beside its answers, with heads of training only.

Columns: where the markings of the car's lane cross the image rows `ROWS`, read from the grid by a
1 x 1 convolution: for each marking and row a softmax over the grid's columns, the label split
between two neighbours. Curvature: that of the road `AHEAD_M` in front of the car, read from the
last shared features: for each distance a softmax over bins. The first keeps apart what is small in
the image, the second says where a bend begins. Labels: `mtlnet.data.road_ahead`; where one is not
known it does not count.
"""

import torch
from torch import Tensor, nn

from mtlnet.model.architecture import HEIGHT, WIDTH, Architecture, grid_size
from mtlnet.model.bins import normal_targets, soft_cross_entropy

ROWS = (112.0, 116.0, 121.0, 127.0, 134.0, 143.0, 154.0, 168.0, 186.0, 206.0)
"""px; a level camera sees 25, 16, 11, 8.4, 6.4, 4.9, 3.8, 3.0, 2.3 and 1.9 m ahead there."""
SIDES = 2  # the lane's left and right marking
AHEAD_M = (0.0, 5.0, 10.0, 15.0, 20.0, 25.0, 30.0, 40.0)
LABELS = SIDES * len(ROWS) + len(AHEAD_M)
COLUMNS_WEIGHT, CURVATURE_WEIGHT = 0.5, 0.1
CURVATURES = 41
SHARPEST = 0.32
"""Bins are even in the root of the curvature, root of 1/m: up to bends of 10 m radius."""


class AuxiliaryHeads(nn.Module):
    """The heads of training only."""

    def __init__(self, plan: Architecture, size: int) -> None:
        super().__init__()
        channels, height, _ = grid_size(plan)
        self.columns = nn.Conv2d(channels, SIDES * len(ROWS), 1)
        self.curvature = nn.Linear(size, len(AHEAD_M) * CURVATURES)
        place = (HEIGHT - plan.first_row) / height
        self.rows = [min(int((row - plan.first_row) / place), height - 1) for row in ROWS]
        """The grid's row in which each image row lies."""

    def forward(self, grid: Tensor, x: Tensor) -> tuple[Tensor, Tensor]:
        """Scores (B, 2, ROWS, w) and (B, AHEAD_M, CURVATURES) of a grid (B, C, h, w) and last
        shared features (B, F)."""
        with torch.autocast(grid.device.type, enabled=False):
            places = self.columns(grid.float())
            places = places.view(len(grid), SIDES, len(ROWS), *grid.shape[2:])
            columns = [places[:, :, number, row] for number, row in enumerate(self.rows)]
            curvature = self.curvature(x.float()).view(-1, len(AHEAD_M), CURVATURES)
            return torch.stack(columns, 2), curvature


def auxiliary_loss(scores: tuple[Tensor, Tensor], labels: Tensor) -> Tensor:
    """The weighted sum of the cross-entropies of both kinds of scores for labels (B, LABELS):
    columns in px, left marking first, then curvatures in 1/m; NaN where unknown."""
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
    """Distributions (..., count) over the grid's columns for places (...) in px: split between the
    two columns between whose middles a place lies."""
    at = (places.nan_to_num() * (count / WIDTH) - 0.5).clamp(0, count - 1)
    number = torch.arange(count, dtype=at.dtype, device=at.device)
    return (1 - (at[..., None] - number).abs()).clamp_min(0)


def _known_mean(losses: Tensor, labels: Tensor) -> Tensor:
    known = ~labels.isnan()
    return (losses * known).sum() / known.sum().clamp_min(1)
