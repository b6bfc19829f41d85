"""The statistics that LeRobot normalises with: of each episode, and of all.

Those of numbers leave absent ones out (a column without any has zeros). Those of images come from
the histogram of every channel over frames spread over the episode, in [0, 1], shaped (3, 1, 1).
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from datagen.recording.images import decode_into
from datagen.view.steps import Step
from trackfeatures.camera import CameraParameters

QUANTILES = {"q01": 0.01, "q10": 0.1, "q50": 0.5, "q90": 0.9, "q99": 0.99}
LEVELS = 256
MOST_IMAGES = 100
"""Frames of an episode whose pixels are counted."""

Stats = dict[str, list[Any]]


def of_numbers(columns: Mapping[str, NDArray[Any]]) -> dict[str, Stats]:
    """Of each column, (N,) or (N, k): lists of k values."""
    return {name: _of_column(column) for name, column in columns.items()}


def _of_column(column: NDArray[Any]) -> Stats:
    rows = column.reshape(len(column), -1).astype(np.float64)
    parts = [_of_values(values[~np.isnan(values)]) for values in rows.T]
    lists = {name: [part[name] for part in parts] for name in parts[0]}
    return {**lists, "count": [len(column)]}


def _of_values(values: NDArray[np.float64]) -> dict[str, float]:
    present = values if values.size else np.zeros(1)
    quantiles = np.quantile(present, list(QUANTILES.values()))
    return {
        "min": float(present.min()),
        "max": float(present.max()),
        "mean": float(present.mean()),
        "std": float(present.std()),
        **dict(zip(QUANTILES, quantiles.tolist(), strict=True)),
    }


class Histogram:
    """How often each level, 0 to 255, of each channel was seen."""

    def __init__(self) -> None:
        self.images = 0
        self.counts = np.zeros((3, LEVELS), np.int64)

    @staticmethod
    def of(steps: Sequence[Step], camera: CameraParameters) -> "Histogram":
        """Raises ValueError where an image cannot be decoded."""
        found = Histogram()
        image = np.empty((camera.height, camera.width, 3), np.uint8)
        chosen = np.linspace(0, len(steps) - 1, min(len(steps), MOST_IMAGES)).astype(int)
        for i in chosen.tolist():
            decode_into(steps[i].image, image)
            found.images += 1
            for channel in range(3):
                found.counts[channel] += np.bincount(image[..., channel].ravel(), minlength=LEVELS)
        return found

    def add(self, other: "Histogram") -> None:
        self.images += other.images
        self.counts += other.counts

    def stats(self) -> Stats:
        parts = [_of_levels(channel) for channel in self.counts]
        shaped = {name: [[[part[name]]] for part in parts] for name in parts[0]}
        return {**shaped, "count": [self.images]}


def _of_levels(counts: NDArray[np.int64]) -> dict[str, float]:
    levels = np.arange(LEVELS) / (LEVELS - 1)
    seen, total = levels[counts > 0], counts.sum()
    mean = float(levels @ counts / total)
    up_to = np.cumsum(counts) / total
    return {
        "min": float(seen[0]),
        "max": float(seen[-1]),
        "mean": mean,
        "std": float(np.sqrt((levels - mean) ** 2 @ counts / total)),
        **{n: float(levels[np.searchsorted(up_to, q)]) for n, q in QUANTILES.items()},
    }
