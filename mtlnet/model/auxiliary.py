"""Auxiliary heads and loss of a network with heads over bins, used only in training.

Columns: where the markings of the car's lane cross the image rows `ROWS`, computed from the grid by
a 1 x 1 convolution. For each marking and row it is a softmax over the columns of the grid; the
label is split between two neighbouring columns. Curvature: the curvature of the road at `AHEAD_M`
in front of the car, computed from the last shared features; for each distance it is a softmax over
bins. The columns preserve small details of the image, the curvature shows where a bend begins.
Labels: `mtlnet.data.road_ahead`; unknown labels do not count.
"""

import torch
from torch import Tensor, nn

from mtlnet.architecture import HEIGHT, WIDTH, Architecture, grid_size
from mtlnet.model.bins import normal_targets, soft_cross_entropy

ROWS = (112.0, 116.0, 121.0, 127.0, 134.0, 143.0, 154.0, 168.0, 186.0, 206.0)
"""Rows, px; a level camera sees the road there at 25, 16, 11, 8.4, 6.4, 4.9, 3.8, 3.0, 2.3 and 1.9
m."""
SIDES = 2  # left and right marking of the lane
AHEAD_M = (0.0, 5.0, 10.0, 15.0, 20.0, 25.0, 30.0, 40.0)
LABELS = SIDES * len(ROWS) + len(AHEAD_M)
COLUMNS_WEIGHT, CURVATURE_WEIGHT = 0.5, 0.1
CURVATURES = 41
SHARPEST = 0.32
"""Limit of the bins, which are equal in the square root of the curvature (1/m): bends of 10 m
radius."""


class AuxiliaryHeads(nn.Module):
    """The auxiliary heads."""

    def __init__(self, plan: Architecture, size: int) -> None:
        super().__init__()
        channels, height, _ = grid_size(plan)
        self.columns = nn.Conv2d(channels, SIDES * len(ROWS), 1)
        self.curvature = nn.Linear(size, len(AHEAD_M) * CURVATURES)
        place = (HEIGHT - plan.first_row) / height
        self.rows = [min(int((row - plan.first_row) / place), height - 1) for row in ROWS]
        """Row of the grid for each of `ROWS`."""

    def forward(self, grid: Tensor, x: Tensor) -> tuple[Tensor, Tensor]:
        """Scores of columns (B, 2, ROWS, w) and curvatures (B, AHEAD_M, CURVATURES), from a grid
        (B, C, h, w) and last shared features (B, F)."""
        with torch.autocast(grid.device.type, enabled=False):
            places = self.columns(grid.float())
            places = places.view(len(grid), SIDES, len(ROWS), *grid.shape[2:])
            columns = [places[:, :, number, row] for number, row in enumerate(self.rows)]
            curvature = self.curvature(x.float()).view(-1, len(AHEAD_M), CURVATURES)
            return torch.stack(columns, 2), curvature


def auxiliary_loss(scores: tuple[Tensor, Tensor], labels: Tensor) -> Tensor:
    """Weighted sum of the cross-entropies of columns and curvatures for labels (B, LABELS): columns
    in px, left marking first, then curvatures in 1/m; NaN where unknown."""
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
    """Distributions (..., count) over the grid's columns for positions (...) in px, each split
    between the two columns whose centres enclose it."""
    at = (places.nan_to_num() * (count / WIDTH) - 0.5).clamp(0, count - 1)
    number = torch.arange(count, dtype=at.dtype, device=at.device)
    return (1 - (at[..., None] - number).abs()).clamp_min(0)


def _known_mean(losses: Tensor, labels: Tensor) -> Tensor:
    known = ~labels.isnan()
    return (losses * known).sum() / known.sum().clamp_min(1)
