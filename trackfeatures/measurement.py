"""Measures track features from the truth: where the car is on a track with painted lanes."""

import math
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from trackfeatures.definitions import (
    BEND_CURVATURE,
    IN_LANE_MARGIN_M,
    LANE_WIDTH_LIMITS_M,
    LANES,
    LOOK_AHEAD_M,
    ON_MARKING_REACH_M,
    OUTSIDE_REACH_M,
    Heading,
    TrackFeatures,
)
from trackfeatures.errors import UserError


class CentreLine(Protocol):
    """A closed track, as far as measuring needs it: m, rad counter-clockwise, 1/m left positive."""

    def project(self, x: float, y: float) -> tuple[float, float]:
        """The foot (s, to_middle) of a point on the centre line."""
        ...

    def heading(self, s: float) -> float: ...

    def curvature(self, s: float) -> float: ...


def check_lanes(lanes: int, lane_width_m: float) -> None:
    """Raise UserError unless the road is one that the definitions cover."""
    if lanes not in LANES:
        raise UserError(f"{lanes} lanes asked for; a road has 1, 2 or 3")
    lo, hi = LANE_WIDTH_LIMITS_M
    if not lo <= lane_width_m <= hi:
        raise UserError(f"lane width {lane_width_m} m asked for; it must be {lo} to {hi} m")


def marking_offsets(lanes: int, lane_width_m: float) -> NDArray[np.float64]:
    """Lateral places (lanes + 1,) of the markings in m, from the leftmost to the rightmost."""
    return lane_width_m * (lanes / 2 - np.arange(lanes + 1, dtype=np.float64))


def lane_index(to_middle: float, lanes: int, lane_width_m: float) -> int:
    """The lane the car is in or nearest to: 0 is the leftmost."""
    lane = math.floor(lanes / 2 - to_middle / lane_width_m)
    return min(max(lane, 0), lanes - 1)


def lane_centre(index: int, lanes: int, lane_width_m: float) -> float:
    """Lateral place of a lane's centre (m, left positive)."""
    return lane_width_m * (lanes / 2 - index - 0.5)


def classify_heading(curvature: float, curvature_ahead: float) -> Heading:
    """The class at a place with `curvature`, and `curvature_ahead` 20 m further on (1/m)."""
    for kappa in (curvature, curvature_ahead):
        if abs(kappa) >= BEND_CURVATURE:
            return Heading.LEFT if kappa > 0 else Heading.RIGHT
    return Heading.STRAIGHT


def wrap_angle(angle: float) -> float:
    """The same angle in [-pi, pi) (rad)."""
    return (angle + math.pi) % (2 * math.pi) - math.pi


def measure(
    to_middle: float,
    angle: float,
    curvature: float,
    curvature_ahead: float,
    lanes: int,
    lane_width_m: float,
) -> TrackFeatures:
    """The features of a car `to_middle` m left of the centre of a road, heading `angle` (rad)."""
    ml, mr = _in_lane(to_middle, lanes, lane_width_m)
    l, m, r = _on_marking(to_middle, lanes, lane_width_m)
    heading = classify_heading(curvature, curvature_ahead)
    return TrackFeatures(ml, mr, l, m, r, angle, heading)


def measure_pose(
    centre_line: CentreLine, x: float, y: float, yaw: float, lanes: int, lane_width_m: float
) -> TrackFeatures:
    """The features of a car at (x, y) in m with `yaw` in rad, counter-clockwise."""
    check_lanes(lanes, lane_width_m)
    s, to_middle = centre_line.project(x, y)
    angle = wrap_angle(centre_line.heading(s) - yaw)
    curvature, ahead = centre_line.curvature(s), centre_line.curvature(s + LOOK_AHEAD_M)
    return measure(to_middle, angle, curvature, ahead, lanes, lane_width_m)


def _in_lane(
    to_middle: float, lanes: int, lane_width_m: float
) -> tuple[float, float] | tuple[None, None]:
    centre = lane_centre(lane_index(to_middle, lanes, lane_width_m), lanes, lane_width_m)
    ml = to_middle - centre - lane_width_m / 2
    mr = to_middle - centre + lane_width_m / 2
    active = -ml >= IN_LANE_MARGIN_M and mr >= IN_LANE_MARGIN_M
    return (ml, mr) if active else (None, None)


def _on_marking(
    to_middle: float, lanes: int, lane_width_m: float
) -> tuple[float | None, float | None, float | None]:
    # Markings are counted from the leftmost, 0, to the rightmost, `lanes`.
    nearest = min(max(round(lanes / 2 - to_middle / lane_width_m), 0), lanes)
    m = to_middle - lane_width_m * (lanes / 2 - nearest)
    outside = (nearest == 0 and m > 0) or (nearest == lanes and m < 0)
    if abs(m) > (OUTSIDE_REACH_M if outside else ON_MARKING_REACH_M):
        return None, None, None
    left = m - lane_width_m if nearest > 0 else None
    right = m + lane_width_m if nearest < lanes else None
    return left, m, right


# Localisation: from distances to markings to the offset from the centre of the lane.


def localise(distances: ArrayLike) -> NDArray[np.float64]:
    """`to_lane_centre` (N,) in m, left positive, NaN where nothing is seen, of distances (N, 5).

    The in-lane pair wins. Else the lane lies on the car's side of the marking `m` it drives on;
    outside the road it is the only lane next to that marking. The same rule for one moment is
    `TrackFeatures.to_lane_centre`.
    """
    ml, mr, l, m, r = np.atleast_2d(np.asarray(distances, dtype=np.float64)).T
    in_lane = (ml + mr) / 2
    right_lane, left_lane = (m + r) / 2, (l + m) / 2
    first = np.where(m <= 0, right_lane, left_lane)
    second = np.where(m <= 0, left_lane, right_lane)
    on_marking = np.where(np.isnan(first), second, first)
    nearest: NDArray[np.float64] = np.where(np.isnan(in_lane), on_marking, in_lane)
    return nearest
