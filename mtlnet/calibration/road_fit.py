"""The road's vanishing point, its bend and the slopes of its markings, from one picture's segments.

Normalised image coordinates x, y: pixels from the principal point divided by the focal length,
turned level. A marking of a flat road is x = x0 + a s + b / s with s = y - y0 > 0: (x0, y0) is the
vanishing point at the camera, `a` grows with the marking's lateral offset by
cos(pitch) / (height cos(heading)), and b = curvature * height / 2 bends all markings alike.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

MIN_BELOW = 0.05
"""Segments nearer to the horizon are left out: 24 m ahead and more, for a camera at 1.2 m."""
MAX_SLOPE = 8.0
SEARCH = (0.09, 0.07)
"""Distance of a picture's vanishing point from the film's, at most: in x (heading) and y."""
MIN_CROSSING = 0.8
"""Difference of slopes of two segments that give a candidate for the vanishing point."""
POINTING_STD = 0.008
MIN_LINE_WEIGHT = 0.05
"""Height of a marking's segments in all, at least."""
BEND_STD = 0.004
"""Prior of b: a radius of 150 m under a camera at 1.2 m."""
MAX_FIT_STD = 0.02
ROUNDS = 5


@dataclass(frozen=True)
class Lines:
    """Segments (N,) in normalised level coordinates; `size` is the height of each."""

    x: FloatArray
    y: FloatArray
    slope: FloatArray
    slope_std: FloatArray
    size: FloatArray

    def chosen(self, rows: NDArray[np.bool_]) -> "Lines":
        """The segments of a mask (N,)."""
        return Lines(
            self.x[rows], self.y[rows], self.slope[rows], self.slope_std[rows], self.size[rows]
        )

    def turned(self, roll: float) -> "Lines":
        """As a camera without the roll (rad) of this one sees them."""
        c, s = np.cos(roll), np.sin(roll)
        along = c + self.slope * s  # of (slope, 1), turned: its part down
        return Lines(
            self.x * c - self.y * s,
            self.x * s + self.y * c,
            (self.slope * c - s) / along,
            self.slope_std / along**2,
            self.size * along,
        )


@dataclass(frozen=True)
class RoadFit:
    """What one picture shows; standard deviations are those of the fit alone."""

    x0: float
    y0: float
    bend: float
    x0_std: float
    y0_std: float
    slopes: tuple[float, ...]
    """Of the markings, leftmost first."""


def fit_road(lines: Lines, x0: float, y0: float) -> RoadFit | None:
    """The fit near the film's vanishing point (x0, y0); None where the markings do not give it."""
    usable = (lines.y > y0 + MIN_BELOW) & (np.abs(lines.slope) < MAX_SLOPE)
    lines = lines.chosen(usable)
    start = _crossing(lines, x0, y0)
    if start is None:
        return None
    return _refine(lines, *start)


def _crossing(lines: Lines, x0: float, y0: float) -> tuple[float, float, FloatArray] | None:
    """The candidate that most segments point to, and the slopes of the markings seen from it."""
    first, second = np.triu_indices(len(lines.x), 1)
    crossing = np.abs(lines.slope[first] - lines.slope[second]) > MIN_CROSSING
    first, second = first[crossing], second[crossing]
    at_zero = lines.x - lines.slope * lines.y
    y = -(at_zero[first] - at_zero[second]) / (lines.slope[first] - lines.slope[second])
    x = at_zero[first] + lines.slope[first] * y
    near = (np.abs(x - x0) < SEARCH[0]) & (np.abs(y - y0) < SEARCH[1])
    if not near.any():
        return None
    x, y = x[near], y[near]
    below = lines.y - y[:, None]
    miss = at_zero + lines.slope * y[:, None] - x[:, None]
    std = np.hypot(POINTING_STD, lines.slope_std * below)
    votes = np.where(below > 0, lines.size * np.exp(-0.5 * (miss / std) ** 2), 0.0)
    best = int(np.argmax(votes.sum(axis=1)))
    agree = votes[best] > 0.3 * lines.size
    slopes = _cluster(
        (lines.x[agree] - x[best]) / (lines.y[agree] - y[best]),
        POINTING_STD / (lines.y[agree] - y[best]),
        lines.size[agree],
    )
    if len(slopes) < 2 or slopes[-1] - slopes[0] < MIN_CROSSING:
        return None
    return float(x[best]), float(y[best]), slopes


def _cluster(slope: FloatArray, std: FloatArray, size: FloatArray) -> FloatArray:
    """Slopes of the markings: means of runs of segments that lie close together."""
    order = np.argsort(slope)
    slope, std, size = slope[order], std[order], size[order]
    gap = np.diff(slope) > 0.12 + std[1:] + std[:-1]
    group = np.concatenate([[0], np.cumsum(gap)]) if len(slope) else np.zeros(0, np.int64)
    total = np.bincount(group, size)
    weight = size / std**2
    mean = np.bincount(group, weight * slope) / np.bincount(group, weight)
    return np.asarray(mean[total > MIN_LINE_WEIGHT], np.float64)


def _refine(lines: Lines, x0: float, y0: float, slopes: FloatArray) -> RoadFit | None:
    """Gauss-Newton over (x0, y0, b, slopes); segments join the marking that they lie on."""
    bend, covariance = 0.0, np.zeros((0, 0))
    for step in range(ROUNDS):
        below = np.maximum(lines.y - y0, 0.5 * MIN_BELOW)
        along = x0 + slopes * below[:, None] + bend / below[:, None]
        off = lines.x[:, None] - along
        marking = np.argmin(np.abs(off), axis=1)
        off = off[np.arange(len(marking)), marking]
        turn = lines.slope - (slopes[marking] - bend / below**2)
        wide = 2.0 if step == 0 else 1.0
        slope_std = np.hypot(lines.slope_std, 0.02 + 0.004 / below)
        on = (np.abs(off) < wide * (0.006 + 0.06 * below)) & (np.abs(turn) < 4.0 * wide * slope_std)
        held = np.bincount(marking[on], lines.size[on], minlength=len(slopes)) > MIN_LINE_WEIGHT
        if held.sum() < 2:
            return None
        on &= held[marking]
        marking = (np.cumsum(held) - 1)[marking]
        slopes = slopes[held]
        s, j, a = below[on], marking[on], slopes[marking[on]]
        place = np.zeros((len(s), 3 + len(slopes)))
        place[:, 0], place[:, 1], place[:, 2] = 1.0, -a + bend / s**2, 1.0 / s
        place[np.arange(len(s)), 3 + j] = s
        tilt = np.zeros_like(place)
        tilt[:, 1], tilt[:, 2] = -2.0 * bend / s**3, -1.0 / s**2
        tilt[np.arange(len(s)), 3 + j] = 1.0
        std = np.concatenate([0.002 + 0.01 * s, slope_std[on]])
        error = np.concatenate([off[on], turn[on]]) / std
        design = np.concatenate([place, tilt]) / std[:, None]
        huber = np.sqrt(1.0 / np.maximum(1.0, np.abs(error) / 1.5))
        design, error = design * huber[:, None], error * huber
        normal = design.T @ design
        normal[2, 2] += BEND_STD**-2
        right = design.T @ error
        right[2] -= bend * BEND_STD**-2
        try:
            covariance = np.linalg.inv(normal)
        except np.linalg.LinAlgError:
            return None
        change = covariance @ right
        x0, y0, bend = x0 + change[0], y0 + change[1], bend + change[2]
        slopes = slopes + change[3:]
    x0_std, y0_std = np.sqrt(np.diag(covariance)[:2])
    if not (x0_std < MAX_FIT_STD and y0_std < MAX_FIT_STD):
        return None
    return RoadFit(x0, y0, bend, x0_std, y0_std, tuple(np.sort(slopes).tolist()))
