"""Estimates a camera's mount from many pictures of a drive: robust means and their spread.

Pitch and yaw are computed from the vanishing point of the markings on straight road, and from the
point towards which the camera travels. The roll is estimated as the angle for which the measured
width of the lane does not depend on the car's position in the lane. The height is computed from the
lane's width. Bends, hills and the driver's corrections average out.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mtlnet.calibration import robust
from mtlnet.calibration.motion import Motion
from mtlnet.calibration.road_fit import Lines, RoadFit, fit_road
from trackfeatures.errors import UserError

FloatArray = NDArray[np.float64]

MIN_PICTURES = 12
"""Least number of pictures that show the lane's two markings on straight road."""
STRAIGHT = 0.002
"""Maximum bend of a fit on straight road: a radius of at least 300 m for a camera at 1.2 m."""
HEIGHTS_M = (0.7, 3.0)
LANE_SPREAD = 0.08
"""Maximum relative difference of a lane's width from the usual width."""
OWN_LANE_STD, OWN_LANE_REPEAT = 0.015, 3.0
"""Relative standard deviation of the measured width of the car's own lane in a picture; number of
consecutive pictures whose errors are similar."""
NEXT_LANES_ROLL_STD = np.radians(1.0)
"""Standard deviation (rad) of the roll for which the neighbouring lanes look as wide as the car's
own lane. It is large, because roads fall off to both sides and lanes differ in width."""
MIN_SLOPE = 0.25
"""Least slope of the markings of the car's own lane. If a slope is smaller, the car is changing
lanes."""
ROLL_PRIOR = np.radians(2.0)
FLOOR = np.radians(0.1)
"""Standard deviation (rad) of the car's own angles: the car moves on its springs and does not run
exactly straight."""
MAX_TURN = 0.06
"""Yaw rate, rad/s, above which the direction of travel differs from the direction of the car."""
WINDOW_S = 0.65
MAX_GAP_S = 0.5
MIN_SPEEDS = 25
ROLL_ROUNDS = 3


class NotCalibrated(UserError):
    """Raised when the pictures of a drive do not show how the camera is mounted."""


@dataclass(frozen=True)
class Sample:
    """The segments of markings in one picture, and its time in s."""

    time_s: float
    lines: Lines


@dataclass(frozen=True)
class TimedMotion:
    """The motion between two pictures that are `seconds` apart; `time_s`: time of the first
    picture, s."""

    time_s: float
    seconds: float
    motion: Motion


@dataclass(frozen=True)
class Mount:
    """The camera's angles in rad and height in m, their standard deviations, and the number of
    pictures used."""

    pitch: float
    yaw: float
    roll: float
    height_m: float
    pitch_std: float
    yaw_std: float
    roll_std: float
    height_std_m: float
    pictures: int


@dataclass(frozen=True)
class _Roads:
    """The road fits of N pictures: an array (N,) for each quantity. `x0`, `y0`, `y0_std` and `bend`
    are the fields of RoadFit. `lane`: difference of the slopes of the own lane's markings."""

    time_s: FloatArray
    x0: FloatArray
    y0: FloatArray
    y0_std: FloatArray
    bend: FloatArray
    lane: FloatArray
    sideways: FloatArray
    """Speed to the right, in camera heights per second; NaN where unknown."""
    widths: FloatArray
    """A row for each lane of all pictures, (M, 4): index of the fit, difference of the slopes of
    its two markings, their mean, 1 for the own lane."""


def find_mount(
    samples: Sequence[Sample],
    motions: Sequence[TimedMotion],
    start: tuple[float, float],
    lane_width_m: float,
    lane_width_std_m: float,
) -> Mount:
    """Estimate the mount from the markings in pictures and the motions between pictures.

    `start`: the film's vanishing point (x, y) in normalised coordinates; `lane_width_m`,
    `lane_width_std_m`: width of the lane and its standard deviation. Raises NotCalibrated if fewer
    than twelve pictures show both markings of a lane on straight road.
    """
    roll, level = 0.0, start
    for _ in range(ROLL_ROUNDS):
        roads = _fit_roads(samples, roll, level, lane_width_m)
        roll += _roll_left(roads.widths, roll)[0]
        straight = _straight(roads)
        level = (float(np.median(roads.x0[straight])), float(np.median(roads.y0[straight])))
    roads = _fit_roads(samples, roll, level, lane_width_m)
    return _combine(roads, motions, roll, lane_width_m, lane_width_std_m)


def _fit_roads(
    samples: Sequence[Sample], roll: float, level: tuple[float, float], lane_width_m: float
) -> _Roads:
    fitted = [(each.time_s, fit_road(each.lines.turned(roll), *level)) for each in samples]
    found = [(time, fit) for time, fit in fitted if fit is not None]
    if len(found) < MIN_PICTURES:
        raise _too_few(len(found), len(samples))
    time = np.array([time for time, _ in found])
    fits = [fit for _, fit in found]
    widths = _lane_widths(fits, lane_width_m)
    lane, centre = np.full(len(fits), np.nan), np.full(len(fits), np.nan)
    own = widths[widths[:, 3] == 1]
    lane[own[:, 0].astype(int)], centre[own[:, 0].astype(int)] = own[:, 1], own[:, 2]
    x0, y0, y0_std, bend = np.array([(f.x0, f.y0, f.y0_std, f.bend) for f in fits]).T
    roads = _Roads(time, x0, y0, y0_std, bend, lane, _sideways(time, -centre), widths)
    seen = int(_straight(roads).sum())
    if seen < MIN_PICTURES:
        raise _too_few(seen, len(samples))
    return roads


def _too_few(seen: int, total: int) -> NotCalibrated:
    return NotCalibrated(
        f"{seen} of {total} pictures show both markings of a lane on straight road; at least "
        f"{MIN_PICTURES} are needed: take a minute of driving on a marked road by day"
    )


def _straight(roads: _Roads) -> NDArray[np.bool_]:
    return (np.abs(roads.bend) < STRAIGHT) & np.isfinite(roads.lane)


def _lane_widths(fits: Sequence[RoadFit], lane_width_m: float) -> FloatArray:
    """Return `_Roads.widths`: the lanes between neighbouring markings whose width is close to the
    usual width of the own lane."""
    rows = []
    for k, fit in enumerate(fits):
        for left, right in zip(fit.slopes[:-1], fit.slopes[1:], strict=True):
            own = left < -MIN_SLOPE and right > MIN_SLOPE
            rows.append((k, right - left, 0.5 * (left + right), own))
    widths = np.array(rows, np.float64).reshape(-1, 4)
    low, high = lane_width_m / HEIGHTS_M[1], lane_width_m / HEIGHTS_M[0]
    own = widths[(widths[:, 3] == 1) & (widths[:, 1] > low) & (widths[:, 1] < high), 1]
    if not len(own):
        return widths[:0]
    close = np.abs(np.log(own[:, None] / own)) < LANE_SPREAD / 2
    usual = float(np.median(own[close[np.argmax(close.sum(axis=1))]]))
    return np.asarray(widths[np.abs(widths[:, 1] / usual - 1.0) < LANE_SPREAD])


def _sideways(time: FloatArray, place: FloatArray) -> FloatArray:
    """Return the rate of change (N,) of the car's lateral position `place` (N,) over `time` (N,) in
    s, for each time from the values within WINDOW_S; NaN where there are too few values or the car
    changes lanes."""
    found = np.full(len(time), np.nan)
    for k in range(len(time)):
        near = (np.abs(time - time[k]) <= WINDOW_S) & np.isfinite(place)
        t, x = time[near] - time[k], place[near]
        if len(t) < 4 or np.diff(t).max() > MAX_GAP_S or t[0] > -0.2 or t[-1] < 0.2:
            continue
        slope = np.polyfit(t, x, 1)
        if np.abs(x - np.polyval(slope, t)).max() < 0.2:
            found[k] = slope[0]
    return found


def _roll_left(widths: FloatArray, roll: float) -> tuple[float, float]:
    """Return the correction of `roll` after which the measured width of the lane does not depend on
    the car's position in the lane, and the standard deviation of the corrected roll, both in rad.

    `widths`: see `_Roads.widths`. A roll r multiplies the measured width of a lane by 1 + 2 r c,
    where c is the mean slope of its two markings.
    """
    found, weight = [-roll], [ROLL_PRIOR**-2]
    own = widths[widths[:, 3] == 1]
    if len(own) >= MIN_PICTURES:
        usual = float(np.median(own[:, 1]))
        spread = float(np.sum((2.0 * (own[:, 2] - own[:, 2].mean())) ** 2))
        for lanes, variance in (
            (own, OWN_LANE_STD**2 * OWN_LANE_REPEAT / max(spread, 1e-9)),
            (widths, NEXT_LANES_ROLL_STD**2),
        ):
            if len(lanes) > len(own) or lanes is own:
                design = np.column_stack([np.ones(len(lanes)), 2.0 * lanes[:, 2]])
                change = robust.fit(design, lanes[:, 1] / usual - 1.0, np.ones(len(lanes)))[1]
                found.append(float(change))
                weight.append(1.0 / variance)
    return float(np.dot(weight, found) / sum(weight)), float(sum(weight) ** -0.5)


def _vanishing_point(roads: _Roads, rows: NDArray[np.int64]) -> tuple[float, float]:
    """Return the vanishing point x0, y0 of straight road for a car that moves along the road, from
    the fits with the indices `rows`."""
    weight = 1.0 / (roads.y0_std[rows] ** 2 + 0.004**2)
    y0 = robust.mean(roads.y0[rows], weight)
    speeds = np.isfinite(roads.sideways[rows])
    if speeds.sum() < MIN_SPEEDS:
        return robust.mean(roads.x0[rows]), y0
    # A car that points to the right of the road moves to the right. In a bend it points inwards.
    side, bend = roads.sideways[rows][speeds], roads.bend[rows][speeds] / STRAIGHT
    design = np.column_stack([np.ones(len(side)), side, bend])
    return float(robust.fit(design, roads.x0[rows][speeds], np.ones(len(side)))[0]), y0


def _combine(
    roads: _Roads,
    motions: Sequence[TimedMotion],
    roll: float,
    lane_width_m: float,
    lane_width_std_m: float,
) -> Mount:
    rng = np.random.default_rng(0)
    straight = np.flatnonzero(_straight(roads))

    def by_markings(rows: NDArray[np.int64]) -> FloatArray:
        chosen = straight[rows]
        return np.array([*_vanishing_point(roads, chosen), robust.mean(roads.lane[chosen])])

    seconds = roads.time_s[straight].astype(np.int64)
    x0, y0, lane = by_markings(np.arange(len(straight)))
    x0_std, y0_std, lane_std = robust.bootstrap_std(seconds, by_markings, rng)
    _, roll_std = _roll_left(roads.widths, roll)
    points = [((x0, y0), (x0_std, y0_std))]
    travel = _travel(motions, roll, rng)
    if travel is not None:
        points.append(travel)
    (x0, x0_std), (y0, y0_std) = (
        _weighted([p[0][k] for p in points], [p[1][k] for p in points]) for k in range(2)
    )
    pitch = -float(np.arctan(y0))
    yaw = float(np.arctan(x0 * np.cos(pitch)))
    height = lane_width_m * np.cos(pitch) / (lane * np.cos(yaw))
    share = np.sqrt((lane_std / lane) ** 2 + (lane_width_std_m / lane_width_m) ** 2 + 0.01**2)
    return Mount(
        pitch,
        yaw,
        roll,
        float(height),
        float(np.hypot(y0_std, FLOOR)),
        float(np.hypot(x0_std, FLOOR)),
        float(np.hypot(roll_std, 2 * FLOOR)),
        float(height * share),
        len(straight),
    )


def _travel(
    motions: Sequence[TimedMotion], roll: float, rng: np.random.Generator
) -> tuple[tuple[float, float], tuple[float, float]] | None:
    """Return the point towards which the camera travels while the car drives straight ahead: x and
    y, corrected for roll, and their standard deviations. None with too few motions."""
    level = [m for m in motions if np.abs(m.motion.rotation[1]) < MAX_TURN * m.seconds]
    if len(level) < MIN_PICTURES:
        return None
    towards = np.array([m.motion.towards for m in level])
    weight = 1.0 / (np.array([m.motion.towards_std for m in level]) ** 2 + 0.005**2)
    c, s = np.cos(roll), np.sin(roll)
    towards = towards @ np.array([[c, s], [-s, c]])

    # In a bend the camera, ahead of the rear axle, travels to the outside of the car's direction.
    turn = np.array([m.motion.rotation[1] / m.seconds for m in level]) / MAX_TURN
    design = np.column_stack([np.ones(len(turn)), turn])

    def mean(rows: NDArray[np.int64]) -> FloatArray:
        x = robust.fit(design[rows], towards[rows, 0], weight[rows])[0]
        return np.array([x, robust.mean(towards[rows, 1], weight[rows])])

    block = np.array([m.time_s for m in level]).astype(np.int64)
    x, y = mean(np.arange(len(level)))
    x_std, y_std = robust.bootstrap_std(block, mean, rng)
    return (x, y), (x_std, y_std)


def _weighted(values: list[float], stds: list[float]) -> tuple[float, float]:
    """Return the mean weighted by inverse variances, to which FLOOR squared is added, and its
    standard deviation, which includes the difference between the values."""
    weight = np.array([1.0 / (std**2 + FLOOR**2) for std in stds])
    found = float(np.dot(weight, values) / weight.sum())
    return found, float(max(weight.sum() ** -0.5, np.ptp(values) / 2))
