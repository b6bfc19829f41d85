"""Computes the statistics that LeRobot uses for normalisation, per episode and per dataset.

Statistics of numbers skip absent values; they are 0 for a column without values. Statistics of
images are in [0, 1] with shape (3, 1, 1). They are computed from histograms of each channel, over
frames spread over the episode.
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
"""Largest number of frames of an episode whose pixels are counted."""

Stats = dict[str, list[Any]]


def column_stats(columns: Mapping[str, NDArray[Any]]) -> dict[str, Stats]:
    """Return the statistics (min, max, mean, std, QUANTILES, count) of each column, (N,) or (N, k),
    as lists of k values."""
    return {name: _stats_of_column(column) for name, column in columns.items()}


def _stats_of_column(column: NDArray[Any]) -> Stats:
    rows = column.reshape(len(column), -1).astype(np.float64)
    parts = [_stats_of_values(values[~np.isnan(values)]) for values in rows.T]
    lists = {name: [part[name] for part in parts] for name in parts[0]}
    return {**lists, "count": [len(column)]}


def _stats_of_values(values: NDArray[np.float64]) -> dict[str, float]:
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
    """Histograms of the pixels of `images` images: `counts` (3, 256) is the number of pixels of
    each level (0 to 255) in each colour channel."""

    def __init__(self) -> None:
        self.images = 0
        self.counts = np.zeros((3, LEVELS), np.int64)

    @staticmethod
    def of(steps: Sequence[Step], camera: CameraParameters) -> "Histogram":
        """Count the pixels in all frames `steps` of an episode, or in 100 frames (MOST_IMAGES)
        evenly spread over a longer episode. Raises ValueError for an image that cannot be
        decoded."""
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
        parts = [_stats_of_levels(channel) for channel in self.counts]
        shaped = {name: [[[part[name]]] for part in parts] for name in parts[0]}
        return {**shaped, "count": [self.images]}


def _stats_of_levels(counts: NDArray[np.int64]) -> dict[str, float]:
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
