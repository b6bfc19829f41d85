"""The course of a round: the car's target offset from the track's centre (m, left positive) at each
metre driven.

The data must cover the whole width of the road and all small angles to it. Each kind of trajectory
covers them differently; a slow random wobble is added to every kind.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

import trackfeatures as tf
from datagen.recording.names import MIDDLE
from simulator.track.road import Road

FloatArray = NDArray[np.float64]

TRAJECTORIES = ("lane", "offsets", "weave", "lane-changes", "yaw-recoveries", "offset-recoveries")
OUTSIDE_M = 1.0
"""Largest distance (m) by which a course lies outside the outermost marking."""
BODY_HALF_WIDTH_M = 0.97
WALL_CLEARANCE_M = 0.75
EDGE_CLEARANCE_M = 0.7
MAX_OFFSET_STEP_M = 4.5
"""Largest change (m) from one constant offset to the next. It keeps the angle to the road small."""
WOBBLE_ANGLE_RAD = 0.024
"""Standard deviation (rad) of the angle to the road that the wobble causes."""
MIDDLE_WOBBLE = 0.5
"""Factor on the wobble for the trajectory MIDDLE. With this factor, the mean distance from the
middle of the lane is 0.17 m. The two vehicles of the paper, which drive on their images, have mean
distances of 0.148 m and 0.175 m."""


@dataclass(frozen=True)
class Course:
    """A course: offset (m, left positive), slope (m/m) and curvature (1/m), each (N,), at every
    metre driven. After N metres it starts again."""

    offset: FloatArray  # m
    slope: FloatArray  # m per m
    curvature: FloatArray  # 1/m, relative to the road

    def at(self, driven_m: float) -> tuple[float, float, float]:
        """Return offset (m, left positive), slope (m/m) and curvature (1/m) after `driven_m`
        metres, interpolated between the two nearest metres."""
        count = len(self.offset)
        cell = int(driven_m)
        part = driven_m - cell
        a, b = cell % count, (cell + 1) % count
        return (
            float(self.offset[a] + part * (self.offset[b] - self.offset[a])),
            float(self.slope[a] + part * (self.slope[b] - self.slope[a])),
            float(self.curvature[a] + part * (self.curvature[b] - self.curvature[a])),
        )


def max_offset(road: Road) -> float:
    """Return the largest distance (m) from the centre of the track that a course on `road` may
    have."""
    return min(
        road.lanes * road.lane_width / 2 + OUTSIDE_M,
        road.edge - EDGE_CLEARANCE_M,
        road.wall_offset - BODY_HALF_WIDTH_M - WALL_CLEARANCE_M,
    )


def make_course(kind: str, road: Road, length_m: float, rng: np.random.Generator) -> Course:
    """Create a random course of `kind` (MIDDLE or one of TRAJECTORIES), at least `length_m` m long.

    Raises UserError for another kind.
    """
    count = max(int(length_m) + 1, 2)  # a gradient needs two values
    if kind not in _MAKERS:
        raise tf.UserError(f"unknown trajectory {kind!r}; choose {', '.join(TRAJECTORIES)}")
    base, smoothing_m = _MAKERS[kind](road, count, rng)
    wobble = _wobble(count, rng) * (MIDDLE_WOBBLE if kind == MIDDLE else 1.0)
    offset = _smooth(base, smoothing_m) + wobble
    # tanh instead of a hard limit keeps the slope smooth.
    limit = max_offset(road)
    offset = limit * np.tanh(1.1 * offset / limit) / np.tanh(1.1)
    offset = _smooth(np.clip(offset, -limit, limit), 3.0)
    slope = np.gradient(offset)
    return Course(offset, slope, np.gradient(slope))


def _lane(road: Road, count: int, rng: np.random.Generator) -> tuple[FloatArray, float]:
    """Return a course (see `Maker`) in one lane, at a small constant offset from the lane's
    centre."""
    lane = int(rng.integers(road.lanes))
    centre = tf.lane_centre(lane, road.lanes, road.lane_width)
    return np.full(count, centre + rng.normal(0.0, 0.4)), 1.0


def _middle(road: Road, count: int, rng: np.random.Generator) -> tuple[FloatArray, float]:
    """Return a course (see `Maker`) in the centre of the middle lane, where the paper's vehicle
    drives."""
    return np.full(count, tf.lane_centre(road.lanes // 2, road.lanes, road.lane_width)), 1.0


def _offsets(road: Road, count: int, rng: np.random.Generator) -> tuple[FloatArray, float]:
    """Return a course (see `Maker`) of constant offsets anywhere on the road. The offset changes
    every 60 to 140 m."""
    limit = max_offset(road)
    offset = rng.uniform(-limit, limit)

    def next_offset() -> float:
        nonlocal offset
        offset = rng.uniform(
            max(offset - MAX_OFFSET_STEP_M, -limit), min(offset + MAX_OFFSET_STEP_M, limit)
        )
        return offset

    return _steps(count, (60.0, 140.0), next_offset, rng), 14.0


def _weave(road: Road, count: int, rng: np.random.Generator) -> tuple[FloatArray, float]:
    """Return a course (see `Maker`) of sine waves. They stay within a lane or extend over the width
    of the road. The wavelength grows with the amplitude."""
    half = road.lanes * road.lane_width / 2
    if rng.uniform() < 0.5:
        middle = tf.lane_centre(int(rng.integers(road.lanes)), road.lanes, road.lane_width)
        amplitude = rng.uniform(0.4, 1.3)
    else:
        middle = rng.uniform(-0.4, 0.4) * max(half - 1.5, 0.0)
        amplitude = rng.uniform(0.4, 0.8) * (half - abs(middle))
    steepest = rng.uniform(0.05, 0.085)
    wave = 2.0 * np.pi * amplitude / steepest
    # The wavelength drifts. With a constant wavelength the angle would depend only on the offset.
    phase = np.cumsum(2.0 * np.pi / wave * (1.0 + 0.3 * _noise(count, 80.0, rng)))
    return middle + amplitude * np.sin(phase + rng.uniform(0.0, 2.0 * np.pi)), 1.0


def _lane_changes(road: Road, count: int, rng: np.random.Generator) -> tuple[FloatArray, float]:
    """Return a course (see `Maker`) with a lane change every 50 to 130 m. On a one-lane road, it
    changes between 1.1 m left and 1.1 m right of the lane's centre instead."""
    centres = np.array([tf.lane_centre(n, road.lanes, road.lane_width) for n in range(road.lanes)])
    if road.lanes == 1:
        centres = np.array([-1.1, 1.1])
    lane = int(rng.integers(len(centres)))

    def change() -> float:
        nonlocal lane
        lane = int(rng.choice([n for n in (lane - 1, lane + 1) if 0 <= n < len(centres)]))
        return float(centres[lane] + rng.normal(0.0, 0.35))

    return _steps(count, (50.0, 130.0), change, rng), 16.0


def _yaw_recoveries(road: Road, count: int, rng: np.random.Generator) -> tuple[FloatArray, float]:
    """Return a course (see `Maker`) in one lane. Every 40 to 90 m it turns away from the direction
    of the lane quickly and returns to its offset slowly."""
    base, _ = _lane(road, count, rng)
    metres = np.arange(count, dtype=np.float64)
    at = rng.uniform(20.0, 60.0)
    while at < count:
        width = rng.uniform(8.0, 14.0)
        # The factor `steepest` is the slope of the added curve at its start.
        steepest = rng.choice([-1.0, 1.0]) * rng.uniform(0.10, 0.24)
        past = np.maximum(metres - at, 0.0)
        base = base + steepest * past * np.exp(-past / width)
        at += rng.uniform(40.0, 90.0)
    return base, 2.0


def _offset_recoveries(
    road: Road, count: int, rng: np.random.Generator
) -> tuple[FloatArray, float]:
    """Return a course (see `Maker`) in one lane. Every 60 to 110 m it is shifted sideways by 1 to
    2.4 m; after 6 to 18 m it begins to return."""
    base, _ = _lane(road, count, rng)
    at = rng.uniform(20.0, 60.0)
    while at < count:
        shift = rng.choice([-1.0, 1.0]) * rng.uniform(1.0, 2.4)
        end, width = at + rng.uniform(6.0, 18.0), rng.uniform(8.0, 16.0)
        base[int(at) : int(end)] += shift
        past = np.arange(int(end), count) - int(end)
        base[int(end) :] += shift * np.exp(-0.5 * (past / width) ** 2)
        at += rng.uniform(60.0, 110.0)
    return base, 4.0


Maker = Callable[[Road, int, np.random.Generator], tuple[FloatArray, float]]
"""A function of road, number of metres `count` and random generator. It returns a course's offsets
(count,) in m, one per metre, and the standard deviation (m) of the Gaussian that smooths them."""
_MAKERS: dict[str, Maker] = {
    MIDDLE: _middle,
    "lane": _lane,
    "offsets": _offsets,
    "weave": _weave,
    "lane-changes": _lane_changes,
    "yaw-recoveries": _yaw_recoveries,
    "offset-recoveries": _offset_recoveries,
}


def _steps(
    count: int,
    apart_m: tuple[float, float],
    next_offset: Callable[[], float],
    rng: np.random.Generator,
) -> FloatArray:
    """Return piecewise constant offsets (count,) in m, one per metre, before smoothing.
    `next_offset` returns the offset of each piece. The length of a piece is random between the two
    limits `apart_m` (m)."""
    offset = np.empty(count)
    at = 0
    while at < count:
        until = at + int(rng.uniform(*apart_m))
        offset[at:until] = next_offset()
        at = until
    return offset


def _wobble(count: int, rng: np.random.Generator) -> FloatArray:
    """Return a slow random drift (count,) of the offset in m, one value per metre, like the drift
    of an inattentive driver."""
    noise = _noise(count, 9.0, rng)
    return noise * (WOBBLE_ANGLE_RAD / max(float(np.gradient(noise).std()), 1e-9))


def _noise(count: int, length_m: float, rng: np.random.Generator) -> FloatArray:
    """Return noise (count,) with standard deviation 1, one value per metre, correlated over about
    `length_m` metres."""
    noise = _smooth(rng.normal(size=count + 64), length_m)[:count]
    return noise / max(float(noise.std()), 1e-9)


def _smooth(values: FloatArray, deviation_m: float) -> FloatArray:
    """Smooth `values` (N,), one per metre, with a Gaussian of standard deviation `deviation_m` (m).
    Beyond the two ends, the first and the last value are repeated."""
    half = int(np.ceil(4.0 * deviation_m))
    kernel = np.exp(-0.5 * (np.arange(-half, half + 1) / deviation_m) ** 2)
    padded = np.pad(values, half, mode="edge")
    return np.convolve(padded, kernel / kernel.sum(), mode="valid")
