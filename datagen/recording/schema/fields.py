"""Describes every recorded field: unit, frame, reference point, limits and meaning of absence.

The JSON schema of a dataset and the tables of its card are generated from this. Names and types of
the fields are the same as in `proto/driverview.proto`.
"""

import math
from dataclasses import dataclass

from trackfeatures.definitions import (
    IN_LANE_MARGIN_M,
    LANE_WIDTH_LIMITS_M,
    LANES,
    ON_MARKING_REACH_M,
    OUTSIDE_REACH_M,
)

TRACK = "track: x along the centre line's tangent, y to the left"
WORLD = "world: x, y in the plane, z up; angles counter-clockwise"
BODY = "body: x ahead, y to the left, z up"
ROAD_PLANE_CG = "centre of gravity, in the road plane"
CG = "centre of gravity"
MIN_LANE_WIDTH_M, MAX_LANE_WIDTH_M = LANE_WIDTH_LIMITS_M
MAX_IN_LANE_M = MAX_LANE_WIDTH_M - IN_LANE_MARGIN_M
NEXT_MARKING_M = (MIN_LANE_WIDTH_M - ON_MARKING_REACH_M, MAX_LANE_WIDTH_M + OUTSIDE_REACH_M)
MAX_LANE_OFFSET_M = MAX_LANE_WIDTH_M / 2 + OUTSIDE_REACH_M
ABSENT_IN_LANE = f"the car is less than {IN_LANE_MARGIN_M} m from a marking of its lane"
ABSENT_ON_MARKING = (
    f"no marking within {ON_MARKING_REACH_M} m, nor an outermost one from outside within "
    f"{OUTSIDE_REACH_M} m"
)


@dataclass(frozen=True, slots=True)
class Field:
    """Description of a recorded field. `low` and `high` are the limits of the value (in a list, of
    each element); `absent` describes when an optional value is unset."""

    meaning: str
    unit: str = "1"
    frame: str = ""
    reference: str = ""
    low: float | None = None
    high: float | None = None
    absent: str = ""


def _distance(meaning: str, low: float, high: float, absent: str) -> Field:
    return Field(meaning, "m", TRACK, ROAD_PLANE_CG, low, high, absent)


def _angle(meaning: str, frame: str, high: float = math.pi) -> Field:
    return Field(meaning, "rad", frame, CG, -high, high)


FIELDS: dict[str, dict[str, Field]] = {
    "TrackFeatures": {
        "to_marking_ml": _distance(
            "to the left marking of the car's lane; negative: it is on the left",
            -MAX_IN_LANE_M, -IN_LANE_MARGIN_M, ABSENT_IN_LANE,
        ),
        "to_marking_mr": _distance(
            "to the right marking of the car's lane; positive: it is on the right",
            IN_LANE_MARGIN_M, MAX_IN_LANE_M, ABSENT_IN_LANE,
        ),
        "to_marking_l": _distance(
            "to the marking left of the one the car drives on; negative",
            -NEXT_MARKING_M[1], -NEXT_MARKING_M[0],
            f"{ABSENT_ON_MARKING}, or none is left of it",
        ),
        "to_marking_m": _distance(
            "to the marking the car drives on; positive: it is on the right",
            -OUTSIDE_REACH_M, OUTSIDE_REACH_M, ABSENT_ON_MARKING,
        ),
        "to_marking_r": _distance(
            "to the marking right of the one the car drives on; positive",
            NEXT_MARKING_M[0], NEXT_MARKING_M[1],
            f"{ABSENT_ON_MARKING}, or none is right of it",
        ),
        "to_lane_centre": _distance(
            "offset from the centre of the lane the car is in or nearest to, left positive",
            -MAX_LANE_OFFSET_M, MAX_LANE_OFFSET_M,
            f"more than {OUTSIDE_REACH_M} m outside the markings",
        ),
        "angle": _angle("track tangent minus yaw: positive when the car points right", TRACK),
        "heading": Field("side to which the road bends here or, on a straight, 20 m ahead"),
        "lanes": Field("lanes of the road", low=min(LANES), high=max(LANES)),
        "lane_index": Field("the car's or nearest lane, 0 leftmost", low=0, high=max(LANES) - 1),
        "curvature": Field(
            "of the centre line at the car, positive in a left-hand bend", "1/m", TRACK, CG
        ),
        "to_middle": Field(
            "offset from the track centre, left positive", "m", TRACK, ROAD_PLANE_CG
        ),
        "s": Field("distance along the centre line from the start line", "m", TRACK, CG, low=0.0),
    },
    "VehicleState": {
        "x": Field("place", "m", WORLD, CG),
        "y": Field("place", "m", WORLD, CG),
        "z": Field("height", "m", WORLD, CG),
        "yaw": _angle("rotation about z", WORLD, math.inf),
        "pitch": _angle("rotation about y", WORLD),
        "roll": _angle("rotation about x", WORLD),
        "vx": Field("velocity ahead", "m/s", BODY, CG),
        "vy": Field("velocity to the left", "m/s", BODY, CG),
        "yaw_rate": Field("counter-clockwise", "rad/s", BODY, CG),
        "shadow_fraction": Field(
            "share of the road within 30 m ahead in a tree's or bridge's shadow", low=0.0, high=1.0
        ),
    },
    "Sensors": {
        "range": Field(
            "to the track's edge, 19 beams from 90 deg left to 90 deg right; -1 off the track",
            "m", BODY, CG, -1.0, 200.0,
        ),
        "angle": _angle("as TrackFeatures.angle", TRACK),
        "speed": Field("magnitude", "km/h", BODY, CG, low=0.0),
        "speed_x": Field("ahead", "km/h", BODY, CG),
        "speed_y": Field("to the left", "km/h", BODY, CG),
        "engine_rotation": Field("of the engine", "rev/min", low=0.0),
        "odometer": Field("driven since the start", "m", low=0.0),
        "lap_time": Field("since the start line was crossed", "s", low=0.0),
        "wheel_spin": Field("front left, front right, rear left, rear right", "rad/s"),
    },
    "Command": {
        "steer": Field("share of the steering lock, 21 deg; left positive", low=-1.0, high=1.0),
        "throttle": Field("asked for", low=0.0, high=1.0),
        "brake": Field("asked for", low=0.0, high=1.0),
        "gear": Field("asked for; -1 backwards, 0 neutral", low=-1, high=6),
    },
}  # fmt: skip
