"""Whether a closed course keeps clear of itself. Metres."""

import math
from typing import Final

import numpy as np

from simulator.track.layout import Segment, cut, place

CLEARANCE_M: Final = 24.0
"""Least distance between the centre lines of two parts of the road: walls that stand up to 12 m from
the centre line never meet, the inner walls of the tightest bend (12 m) included. A road of
three lanes of 4.3 m with shoulders of 3 m has its walls at 11.95 m."""
STEP_M: Final = 3.0
MARGIN_M: Final = 0.2
"""Two lines at `CLEARANCE_M` may be sampled this much farther apart: half a step sideways."""


def keeps_clear(segments: list[Segment]) -> bool:
    """Whether no two parts of a closed course are nearer than `CLEARANCE_M`.

    Parts closer along the road than half the circle of that diameter need no check: where no radius
    is below half of it, they are on no sharper bend than that circle.
    """
    placed = place(cut(segments))
    total = float(placed.s0[-1] + placed.length[-1])
    count = math.ceil(total / STEP_M)
    s = np.arange(count) * (total / count)
    # Pieces are at most 5 m long: the chord between their ends is near enough to the road.
    nodes = np.append(placed.s0, total)
    x = np.interp(s, nodes, np.append(placed.x0, placed.end[0]))
    y = np.interp(s, nodes, np.append(placed.y0, placed.end[1]))
    near = math.ceil(math.pi / 2.0 * CLEARANCE_M / (total / count))
    least = (CLEARANCE_M + MARGIN_M) ** 2
    # Every pair once: each sample with those up to half a lap ahead.
    x2, y2 = np.concatenate((x, x)), np.concatenate((y, y))
    ahead = np.lib.stride_tricks.sliding_window_view
    width = count // 2 + 1
    dx = ahead(x2, width)[:count, near:] - x[:, None]
    dy = ahead(y2, width)[:count, near:] - y[:, None]
    return bool((dx * dx + dy * dy).min() >= least)
