"""Checks that no part of a closed course is too near to another part. Metres."""

import math
from typing import Final

import numpy as np

from simulator.arrays import FloatArray
from simulator.track.layout import Segment, cut, place

CLEARANCE_M: Final = 24.0
"""Least distance (m) between the centre lines of two parts of the road. With this distance, walls
up to 12 m from the centre line never meet, nor do the inner walls of the tightest bend (radius
12 m). A road of three lanes of 4.3 m with shoulders of 3 m has its walls at 11.95 m."""
STEP_M: Final = 3.0
MOST_SAMPLES: Final = 500
BULGE_M: Final = 0.3
"""Largest distance (m) between a bend and the chord of a piece: 0.26 m for a piece of 5 m length
and a radius of 12 m."""


def keeps_clear(segments: list[Segment]) -> bool:
    """Return whether the centre lines of all parts of a closed course are at least 24 m apart.

    Points that are less than 12 pi m apart along the road are not compared. 12 pi m is half a turn
    of the tightest bend (radius 12 m), so these points belong to the same part of the road.
    """
    placed = place(cut(segments))
    total = float(placed.s0[-1] + placed.length[-1])
    count = min(math.ceil(total / STEP_M), MOST_SAMPLES)
    step = total / count
    s = np.arange(count) * step
    nodes = np.append(placed.s0, total)
    x = np.interp(s, nodes, np.append(placed.x0, placed.end[0]))
    y = np.interp(s, nodes, np.append(placed.y0, placed.end[1]))
    near = math.ceil(math.pi / 2.0 * CLEARANCE_M / step)
    # In a tight bend, samples of two lines can be half a step apart along the lines.
    least = CLEARANCE_M + BULGE_M + step * step / 64.0
    # Each sample is compared with the samples up to half a lap ahead, so each pair once.
    ahead_x, ahead_y = (_ahead(values, near, count // 2 + 1) for values in (x, y))
    dx, dy = ahead_x - x[:, None], ahead_y - y[:, None]
    return bool((dx * dx + dy * dy).min() >= least * least)


def _ahead(values: FloatArray, first: int, last: int) -> FloatArray:
    """Return for each of `values` (N,) the values (N, last - first) that lie `first` to `last`
    positions after it, round the lap."""
    lap = np.concatenate((values, values))
    return np.lib.stride_tricks.sliding_window_view(lap, last)[: len(values), first:]
