"""Measures track features from the true pose of a car, and the lane offset from track features.

SI units. `to_middle` is the car's lateral distance from the centre line of the road, left positive.
"""

import math
from collections.abc import Sequence
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from trackfeatures.definitions import (
    IN_LANE_MARGIN_M,
    LANE_WIDTH_LIMITS_M,
    LANES,
    ON_MARKING_REACH_M,
    OUTSIDE_REACH_M,
    TrackFeatures,
    lane_offset,
)
from trackfeatures.errors import UserError
from trackfeatures.road_class import LOOK_AHEAD_M, classify_heading

LineOffsets = Sequence[tuple[float, float]]
"""Two offsets for each marking, in m from the nominal position of the marking, left positive: first
the offset of the line that bounds the lane left of the marking, then the offset of the line that
bounds the lane right of the marking."""
LEFT_LANE, RIGHT_LANE = range(2)
_ONE_LINE: LineOffsets = ((0.0, 0.0),) * (max(LANES) + 1)


class CentreLine(Protocol):
    """Centre line of a closed track. Lengths in m, angles in rad (counter-clockwise positive),
    curvatures in 1/m (left positive)."""

    def project(self, x: float, y: float) -> tuple[float, float]:
        """Return arc length `s` and lateral distance `to_middle` of a point, both in m."""

    def heading(self, s: float) -> float: ...

    def curvature(self, s: float) -> float: ...


def check_lanes(lanes: int, lane_width_m: float) -> None:
    """Raises UserError unless `lanes` is 1, 2 or 3, as an integer and not as a bool, and
    `lane_width_m` is 2.7 to 4.5 m."""
    whole = isinstance(lanes, int | np.integer) and not isinstance(lanes, bool)
    if not whole or lanes not in LANES:
        raise UserError(f"a road of {lanes!r} lanes is not supported; give 1, 2 or 3")
    lo, hi = LANE_WIDTH_LIMITS_M
    if not lo <= lane_width_m <= hi:
        raise UserError(f"lane width {lane_width_m} m is out of range; give {lo} to {hi} m")


def marking_offsets(lanes: int, lane_width_m: float) -> NDArray[np.float64]:
    """Return the lateral positions (lanes + 1,) of the markings in m left of the road's centre
    line, leftmost first."""
    return lane_width_m * (lanes / 2 - np.arange(lanes + 1, dtype=np.float64))


def lane_index(to_middle: float, lanes: int, lane_width_m: float) -> int:
    """Return the index of the lane that the car is in or nearest to; 0 is the leftmost lane. The
    car is `to_middle` m left of the centre line of the road."""
    lane = math.floor(lanes / 2 - to_middle / lane_width_m)
    return min(max(lane, 0), lanes - 1)


def lane_centre(index: int, lanes: int, lane_width_m: float) -> float:
    """Return the lateral position of the centre of lane `index` (m left of the road's centre line);
    lane 0 is the leftmost lane."""
    return lane_width_m * (lanes / 2 - index - 0.5)


def wrap_angle(angle: float) -> float:
    """Return the equivalent angle in [-pi, pi) (rad)."""
    return (angle + math.pi) % (2 * math.pi) - math.pi


def measure(
    to_middle: float,
    angle: float,
    curvature: float,
    curvature_ahead: float,
    lanes: int,
    lane_width_m: float,
    line_offsets: LineOffsets = (),
) -> TrackFeatures:
    """Return the features of a car `to_middle` m left of the centre line, at `angle` (rad) to the
    road.

    `curvature` and `curvature_ahead` (1/m, left positive) are the road's curvatures at the car and
    20 m ahead of the car. `line_offsets` (see `LineOffsets`) is needed for double lines, where the
    nearer line bounds each adjacent lane. Without `line_offsets` every line is at the nominal
    position of its marking.
    """
    offsets = line_offsets or _ONE_LINE
    ml, mr = in_lane_distances(to_middle, lanes, lane_width_m, offsets)
    l, m, r = on_marking_distances(to_middle, lanes, lane_width_m, offsets)
    heading = classify_heading(curvature, curvature_ahead)
    return TrackFeatures(ml, mr, l, m, r, angle, heading)


def measure_pose(
    centre_line: CentreLine, x: float, y: float, yaw: float, lanes: int, lane_width_m: float
) -> TrackFeatures:
    """Return the features of a car at (x, y) in m with `yaw` in rad (counter-clockwise), on a road
    with `lanes` lanes around `centre_line`. Raises the errors of `check_lanes`."""
    check_lanes(lanes, lane_width_m)
    s, to_middle = centre_line.project(x, y)
    angle = wrap_angle(centre_line.heading(s) - yaw)
    curvature, ahead = centre_line.curvature(s), centre_line.curvature(s + LOOK_AHEAD_M)
    return measure(to_middle, angle, curvature, ahead, lanes, lane_width_m)


def in_lane_distances(
    to_middle: float, lanes: int, lane_width_m: float, offsets: LineOffsets
) -> tuple[float, float] | tuple[None, None]:
    """Return `ml` and `mr` (m), or (None, None) if the car is less than 0.5 m from one of these
    markings. `offsets` are `LineOffsets`. The simulator also compiles this function with numba."""
    lane = lane_index(to_middle, lanes, lane_width_m)
    beside = to_middle - lane_centre(lane, lanes, lane_width_m)
    ml = beside - lane_width_m / 2 - offsets[lane][RIGHT_LANE]
    mr = beside + lane_width_m / 2 - offsets[lane + 1][LEFT_LANE]
    active = -ml >= IN_LANE_MARGIN_M and mr >= IN_LANE_MARGIN_M
    return (ml, mr) if active else (None, None)


def on_marking_distances(
    to_middle: float, lanes: int, lane_width_m: float, offsets: LineOffsets
) -> tuple[float | None, float | None, float | None]:
    """Return `l`, `m` and `r` (m). A distance to a marking that does not exist is None. All three
    are None if no marking is near: within 1.2 m of the car, or within 2 m of a car outside the
    road. `offsets` are `LineOffsets`."""
    # Markings are numbered from 0 (leftmost) to `lanes` (rightmost).
    nearest = min(max(round(lanes / 2 - to_middle / lane_width_m), 0), lanes)
    place = to_middle - lane_width_m * (lanes / 2 - nearest)
    outside = (nearest == 0 and place > 0) or (nearest == lanes and place < 0)
    # Inside the road the car's lane is on the car's side of the marking; outside, on the far side.
    m = place - offsets[nearest][LEFT_LANE if (place > 0) != outside else RIGHT_LANE]
    if abs(m) > (OUTSIDE_REACH_M if outside else ON_MARKING_REACH_M):
        return None, None, None
    left = place - lane_width_m - offsets[nearest - 1][RIGHT_LANE] if nearest > 0 else None
    right = place + lane_width_m - offsets[nearest + 1][LEFT_LANE] if nearest < lanes else None
    return left, m, right


def localise(distances: ArrayLike) -> NDArray[np.float64]:
    """Return the offsets (N,) in m of the car from the centre of the nearest lane, left positive,
    for `distances` (N, 5) in m (ml, mr, l, m, r; NaN: absent). The offset is NaN if no lane is
    visible."""
    rows = np.atleast_2d(np.asarray(distances, dtype=np.float64)).tolist()
    present = ((None if math.isnan(d) else d for d in row) for row in rows)
    offsets = (lane_offset(*row) for row in present)
    return np.array([math.nan if d is None else d for d in offsets], dtype=np.float64)
