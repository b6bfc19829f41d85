"""Groups of frames by which a model is evaluated: track, lanes, light, shadow, radius, speed."""

from collections.abc import Iterator
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from datagen.recording import Frames

GROUPS = {
    "by_track": "track",
    "by_lanes": "lanes",
    "by_light": "light",
    "by_shadow": "road in shadow",
    "by_radius": "radius of the bend",
    "by_speed": "speed",
}
SHADOW = (0.05, 0.3, 0.6)
"""Limits of the share of the road within 30 m that lies in shadow."""
RADIUS_M = (40.0, 80.0, 170.0)
"""Limits of the radius of the bend; the heading class of a larger one is straight."""
SPEED_KMH = (30.0, 45.0, 60.0)


def groups(frames: "Frames") -> Iterator[tuple[str, dict[str, NDArray[np.int64]]]]:
    """Each grouping: its name in `GROUPS`, and the rows of each of its groups, in order.

    Each frame is in one group of every grouping.
    """
    labels = frames.labels
    of_round = labels.round
    yield "by_track", _by_value(np.array([info.track for info in frames.rounds])[of_round])
    yield "by_lanes", _by_value(labels.lanes.astype(str))
    yield "by_light", _by_value(labels.light)
    yield "by_shadow", _by_range(labels.shadow_fraction, SHADOW, "")
    radius = 1 / np.maximum(np.abs(labels.curvature), 1e-9)
    yield "by_radius", _by_range(radius, RADIUS_M, " m")
    yield "by_speed", _by_range(labels.speed * 3.6, SPEED_KMH, " km/h")


def _by_value(keys: NDArray[np.str_]) -> dict[str, NDArray[np.int64]]:
    return {key: np.flatnonzero(keys == key) for key in np.unique(keys).tolist()}


def _by_range(
    values: NDArray[Any], limits: tuple[float, ...], unit: str
) -> dict[str, NDArray[np.int64]]:
    names = [f"under {limits[0]:g}{unit}"]
    names += [f"{lo:g} to {hi:g}{unit}" for lo, hi in pairwise(limits)]
    names += [f"over {limits[-1]:g}{unit}"]
    numbers = np.digitize(values, limits)
    rows = {name: np.flatnonzero(numbers == i) for i, name in enumerate(names)}
    return {name: found for name, found in rows.items() if len(found)}
