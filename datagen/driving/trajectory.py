"""The lateral course a round is to follow: an offset for each metre driven, left positive, in m.

Perception must see every place on the road and every small angle, so no round just keeps its lane:
each kind covers the width in another way, and a slow wobble lies over all of them.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

import trackfeatures as tf
from simulator.track.road import Road

FloatArray = NDArray[np.float64]

KINDS = ("lane", "offsets", "weave", "lane-changes", "yaw-recoveries", "offset-recoveries")
OUTSIDE_M = 1.0
"""Farthest from an outer marking, outwards, that a course leads."""
BODY_HALF_WIDTH_M = 0.97
WALL_CLEARANCE_M = 0.75
EDGE_CLEARANCE_M = 0.7
JUMP_M = 4.5
"""Farthest move between two offsets: more at once would be steep."""
WOBBLE_ANGLE_RAD = 0.024
"""Standard deviation of the wobble's angle to the road."""


@dataclass(frozen=True)
class Course:
    """Offset, slope and bend of the course at each metre driven; beyond its end it repeats."""

    offset: FloatArray  # m
    slope: FloatArray  # m per m
    bend: FloatArray  # 1/m

    def at(self, driven_m: float) -> tuple[float, float, float]:
        """Offset (m), slope and bend (1/m) after `driven_m`, linear between the metres."""
        count = len(self.offset)
        cell = int(driven_m)
        part = driven_m - cell
        a, b = cell % count, (cell + 1) % count
        return (
            float(self.offset[a] + part * (self.offset[b] - self.offset[a])),
            float(self.slope[a] + part * (self.slope[b] - self.slope[a])),
            float(self.bend[a] + part * (self.bend[b] - self.bend[a])),
        )


def reach(road: Road) -> float:
    """How far from the track centre a course may lead."""
    return min(
        road.lanes * road.lane_width / 2 + OUTSIDE_M,
        road.edge - EDGE_CLEARANCE_M,
        road.wall_offset - BODY_HALF_WIDTH_M - WALL_CLEARANCE_M,
    )


def make_course(kind: str, road: Road, length_m: float, rng: np.random.Generator) -> Course:
    """A course of `kind` (one of KINDS), at least `length_m` long."""
    count = int(length_m) + 1
    if kind not in _MAKERS:
        raise tf.UserError(f"unknown trajectory {kind!r}; choose {', '.join(KINDS)}")
    base, smoothing_m = _MAKERS[kind](road, count, rng)
    offset = _smooth(base, smoothing_m) + _wobble(count, rng)
    # Bounded softly at the end of what is allowed, so that the slope stays smooth.
    limit = reach(road)
    offset = limit * np.tanh(1.1 * offset / limit) / np.tanh(1.1)
    offset = _smooth(np.clip(offset, -limit, limit), 3.0)
    slope = np.gradient(offset)
    return Course(offset, slope, np.gradient(slope))


def _lane(road: Road, count: int, rng: np.random.Generator) -> tuple[FloatArray, float]:
    """One lane, a little beside its centre."""
    lane = int(rng.integers(road.lanes))
    centre = tf.lane_centre(lane, road.lanes, road.lane_width)
    return np.full(count, centre + rng.normal(0.0, 0.4)), 1.0


def _offsets(road: Road, count: int, rng: np.random.Generator) -> tuple[FloatArray, float]:
    """Constant offsets anywhere on the road, another one every 60 to 140 m."""
    limit = reach(road)
    offset = rng.uniform(-limit, limit)

    def another() -> float:
        nonlocal offset
        offset = rng.uniform(max(offset - JUMP_M, -limit), min(offset + JUMP_M, limit))
        return offset

    return _steps(count, (60.0, 140.0), another, rng), 14.0


def _weave(road: Road, count: int, rng: np.random.Generator) -> tuple[FloatArray, float]:
    """Waves within a lane or over the width of the road; wide ones are long ones."""
    half = road.lanes * road.lane_width / 2
    if rng.uniform() < 0.5:
        middle = tf.lane_centre(int(rng.integers(road.lanes)), road.lanes, road.lane_width)
        amplitude = rng.uniform(0.4, 1.3)
    else:
        middle = rng.uniform(-0.4, 0.4) * max(half - 1.5, 0.0)
        amplitude = rng.uniform(0.4, 0.8) * (half - abs(middle))
    steepest = rng.uniform(0.05, 0.085)
    wave = 2.0 * np.pi * amplitude / steepest
    # The length of the waves drifts: a fixed one would tie the angle to the offset.
    phase = np.cumsum(2.0 * np.pi / wave * (1.0 + 0.3 * _noise(count, 80.0, rng)))
    return middle + amplitude * np.sin(phase + rng.uniform(0.0, 2.0 * np.pi)), 1.0


def _lane_changes(road: Road, count: int, rng: np.random.Generator) -> tuple[FloatArray, float]:
    """From lane to lane every 50 to 130 m; on one lane, from one side of it to the other."""
    places = np.array([tf.lane_centre(n, road.lanes, road.lane_width) for n in range(road.lanes)])
    if road.lanes == 1:
        places = np.array([-1.1, 1.1])
    place = int(rng.integers(len(places)))

    def change() -> float:
        nonlocal place
        place = int(rng.choice([n for n in (place - 1, place + 1) if 0 <= n < len(places)]))
        return float(places[place] + rng.normal(0.0, 0.35))

    return _steps(count, (50.0, 130.0), change, rng), 16.0


def _yaw_recoveries(road: Road, count: int, rng: np.random.Generator) -> tuple[FloatArray, float]:
    """A lane, from which the car is turned away every 40 to 90 m and steers back."""
    base, _ = _lane(road, count, rng)
    metres = np.arange(count, dtype=np.float64)
    at = rng.uniform(20.0, 60.0)
    while at < count:
        width = rng.uniform(8.0, 14.0)
        # Away at once, back slowly; the factor e/width makes `steepest` the slope at its start.
        steepest = rng.choice([-1.0, 1.0]) * rng.uniform(0.10, 0.24)
        past = np.maximum(metres - at, 0.0)
        base = base + steepest * past * np.exp(-past / width)
        at += rng.uniform(40.0, 90.0)
    return base, 2.0


def _offset_recoveries(
    road: Road, count: int, rng: np.random.Generator
) -> tuple[FloatArray, float]:
    """A lane, from which the car is pushed 1 to 2.4 m aside every 60 to 110 m: it finds itself
    there, straight on, for some metres, and comes back."""
    base, _ = _lane(road, count, rng)
    at = rng.uniform(20.0, 60.0)
    while at < count:
        aside = rng.choice([-1.0, 1.0]) * rng.uniform(1.0, 2.4)
        there, back = at + rng.uniform(6.0, 18.0), rng.uniform(8.0, 16.0)
        base[int(at) : int(there)] += aside
        past = np.arange(int(there), count) - int(there)
        base[int(there) :] += aside * np.exp(-0.5 * (past / back) ** 2)
        at += rng.uniform(60.0, 110.0)
    return base, 4.0


Maker = Callable[[Road, int, np.random.Generator], tuple[FloatArray, float]]
_MAKERS: dict[str, Maker] = {
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
    """Constant offsets with jumps; smoothing makes the transitions."""
    offset = np.empty(count)
    at = 0
    while at < count:
        until = at + int(rng.uniform(*apart_m))
        offset[at:until] = next_offset()
        at = until
    return offset


def _wobble(count: int, rng: np.random.Generator) -> FloatArray:
    """Slow drifting to and fro, as of a driver who does not quite attend."""
    noise = _noise(count, 9.0, rng)
    return noise * (WOBBLE_ANGLE_RAD / max(float(np.gradient(noise).std()), 1e-9))


def _noise(count: int, length_m: float, rng: np.random.Generator) -> FloatArray:
    """Smooth noise of unit deviation over about `length_m`."""
    noise = _smooth(rng.normal(size=count + 64), length_m)[:count]
    return noise / max(float(noise.std()), 1e-9)


def _smooth(values: FloatArray, deviation_m: float) -> FloatArray:
    """Gaussian mean over the metres, with the ends held."""
    half = int(np.ceil(4.0 * deviation_m))
    kernel = np.exp(-0.5 * (np.arange(-half, half + 1) / deviation_m) ** 2)
    padded = np.pad(values, half, mode="edge")
    return np.convolve(padded, kernel / kernel.sum(), mode="valid")
