"""Fits the road's vanishing point, bend and slopes of markings to the segments of one picture.

Normalised image coordinates x, y: pixels from the principal point divided by the focal length,
corrected for roll. A marking of a flat road is x = x0 + a s + b / s with s = y - y0 > 0. Here (x0,
y0) is the vanishing point of the road's direction at the camera. The slope a is (lateral offset /
height) * cos(pitch) / cos(heading), and b = curvature * height / 2 bends all markings alike.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

MIN_BELOW = 0.05
"""Least distance of a segment below the horizon: 24 m ahead for a camera 1.2 m above the road."""
MAX_SLOPE = 8.0
SEARCH = (0.09, 0.07)
"""Maximum distance of a picture's vanishing point from the film's, in x (heading) and y."""
MIN_CROSSING = 0.8
"""Least difference of the slopes of two segments whose intersection is a candidate for the
vanishing point."""
POINTING_STD = 0.008
MIN_LINE_WEIGHT = 0.05
"""Least sum of the extents in y (normalised coordinates) of a marking's segments."""
BEND_STD = 0.004
"""Standard deviation of the prior of b: a radius of 150 m for a camera 1.2 m above the road."""
MAX_FIT_STD = 0.02
ROUNDS = 5


@dataclass(frozen=True, slots=True)
class Lines:
    """N segments in normalised coordinates, as arrays (N,): position `x`, `y` of the middle,
    `slope` dx/dy and its standard deviation, and `size`, the extent in y."""

    x: FloatArray
    y: FloatArray
    slope: FloatArray
    slope_std: FloatArray
    size: FloatArray

    def chosen(self, rows: NDArray[np.bool_]) -> "Lines":
        """Return the segments selected by the mask `rows` (N,)."""
        return Lines(
            self.x[rows], self.y[rows], self.slope[rows], self.slope_std[rows], self.size[rows]
        )

    def turned(self, roll: float) -> "Lines":
        """Return the segments as the camera would see them if it had no roll. `roll`: roll of the
        camera, rad."""
        c, s = np.cos(roll), np.sin(roll)
        along = c + self.slope * s  # the vertical part of (slope, 1) after the rotation
        return Lines(
            self.x * c - self.y * s,
            self.x * s + self.y * c,
            (self.slope * c - s) / along,
            self.slope_std / along**2,
            self.size * along,
        )


@dataclass(frozen=True)
class RoadFit:
    """The fit of one picture, in normalised coordinates: vanishing point x0, y0, and `bend`, which
    is b in the formula of this module. `y0_std` is the standard deviation of y0 from the fit alone,
    without the movement of the car on its springs."""

    x0: float
    y0: float
    bend: float
    y0_std: float
    slopes: tuple[float, ...]
    """Slopes of the markings, leftmost first."""


def fit_road(lines: Lines, x0: float, y0: float) -> RoadFit | None:
    """Fit the road to the segments `lines`, with a vanishing point near the film's vanishing point
    (x0, y0). None where the segments do not determine the fit."""
    usable = (lines.y > y0 + MIN_BELOW) & (np.abs(lines.slope) < MAX_SLOPE)
    lines = lines.chosen(usable)
    start = _crossing(lines, x0, y0)
    if start is None:
        return None
    return _refine(lines, *start)


def _crossing(lines: Lines, x0: float, y0: float) -> tuple[float, float, FloatArray] | None:
    """Return x and y of the vanishing point to which most segments point, and the slopes of the
    markings; None if no vanishing point is found near (`x0`, `y0`), the film's vanishing point."""
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
    """Return the slopes of the markings: the means of groups of segments with similar slopes."""
    order = np.argsort(slope)
    slope, std, size = slope[order], std[order], size[order]
    gap = np.diff(slope) > 0.12 + std[1:] + std[:-1]
    group = np.concatenate([[0], np.cumsum(gap)]) if len(slope) else np.zeros(0, np.int64)
    total = np.bincount(group, size)
    weight = size / std**2
    mean = np.bincount(group, weight * slope) / np.bincount(group, weight)
    return np.asarray(mean[total > MIN_LINE_WEIGHT], np.float64)


def _refine(lines: Lines, x0: float, y0: float, slopes: FloatArray) -> RoadFit | None:
    """Refine (x0, y0, b, slopes) by the Gauss-Newton method. Each segment is assigned to the
    marking that it lies on. Returns None if the result is too uncertain."""
    state: FloatArray = np.array([x0, y0, 0.0, *slopes])
    covariance: FloatArray = np.zeros((0, 0))
    for step in range(ROUNDS):
        on, marking, held = _members(lines, state, 2.0 if step == 0 else 1.0)
        if held.sum() < 2:
            return None
        state = np.concatenate([state[:3], state[3:][held]])
        design, error = _equations(lines.chosen(on), marking[on], state)
        design[-1, 2], error[-1] = 1.0 / BEND_STD, -state[2] / BEND_STD
        try:
            covariance = np.asarray(np.linalg.inv(design.T @ design), np.float64)
        except np.linalg.LinAlgError:
            return None
        state = state + covariance @ design.T @ error
    x0_std, y0_std = np.sqrt(np.diag(covariance)[:2])
    if not (x0_std < MAX_FIT_STD and y0_std < MAX_FIT_STD):
        return None
    x0, y0, bend = map(float, state[:3])
    return RoadFit(x0, y0, bend, float(y0_std), tuple(np.sort(state[3:]).tolist()))


def _below(lines: Lines, y0: float) -> FloatArray:
    """Return the distance in y (N,) of each segment below the horizon, at least half MIN_BELOW."""
    return np.asarray(np.maximum(lines.y - y0, 0.5 * MIN_BELOW), np.float64)


def _slope_std(lines: Lines, below: FloatArray) -> FloatArray:
    """Return the standard deviation (N,) of the difference between the slopes of a segment and of
    its marking, including the effect of an uneven road. `below` (N,): see `_below`."""
    return np.asarray(np.hypot(lines.slope_std, 0.02 + 0.004 / below), np.float64)


def _members(
    lines: Lines, state: FloatArray, wide: float
) -> tuple[NDArray[np.bool_], NDArray[np.int64], NDArray[np.bool_]]:
    """Assign the segments to markings; returns a mask of the segments that lie on a kept marking,
    the index of each segment's marking among the kept markings, and a mask of the kept markings.

    `state`: x0, y0, b and the slope of each marking. `wide`: factor on the allowed distance of a
    segment from its marking.
    """
    x0, y0, bend = state[:3]
    slopes, below = state[3:], _below(lines, y0)
    away = lines.x[:, None] - (x0 + slopes * below[:, None] + bend / below[:, None])
    marking = np.argmin(np.abs(away), axis=1)
    off = np.abs(away).min(axis=1)
    turn = np.abs(lines.slope - slopes[marking] + bend / below**2)
    on = (off < wide * (0.006 + 0.06 * below)) & (turn < 4.0 * wide * _slope_std(lines, below))
    size = np.bincount(marking[on], lines.size[on], minlength=len(slopes))
    held = size > MIN_LINE_WEIGHT
    return on & held[marking], (np.cumsum(held) - 1)[marking], held


def _equations(
    lines: Lines, marking: NDArray[np.int64], state: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the design matrix (2 N + 1, P) and the errors (2 N + 1,) of the positions and slopes
    of the N segments, divided by their standard deviations and weighted by Huber's weights. The
    caller fills the last row with the prior of b. `state` (P,): x0, y0, b and the slope of each
    marking; `marking` (N,): index of each segment's marking."""
    x0, y0, bend = state[:3]
    s, a, n = _below(lines, y0), state[3:][marking], len(lines.x)
    own = 3 + marking
    design, std = np.zeros((2 * n + 1, len(state))), np.ones(2 * n + 1)
    place, slope = design[:n], design[n:-1]
    place[:, 0], place[:, 1], place[:, 2] = 1.0, -a + bend / s**2, 1.0 / s
    place[np.arange(n), own] = s
    slope[:, 1], slope[:, 2] = -2.0 * bend / s**3, -1.0 / s**2
    slope[np.arange(n), own] = 1.0
    std[:n], std[n:-1] = 0.002 + 0.01 * s, _slope_std(lines, s)
    off = lines.x - (x0 + a * s + bend / s)
    turn = lines.slope - (a - bend / s**2)
    error = np.concatenate([off, turn, [0.0]]) / std
    weight = np.sqrt(1.0 / np.maximum(1.0, np.abs(error) / 1.5)) / std
    return design * weight[:, None], error * weight * std
