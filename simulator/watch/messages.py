"""JSON messages to a browser: the scene message is sent once per road, the state message with every
image. Values are in SI units unless a name states another unit. Angles are counter-clockwise; only
`angle` is track tangent minus yaw."""

import json
import math
from typing import Any, Final

import numpy as np

from simulator.camera import KINDS, VIEWS
from simulator.sensors.beams import BEAM_ANGLES, RANGE_M
from simulator.sensors.standard import read_range
from simulator.track.road import Road
from simulator.traffic.traffic import EGO_CAR_SIZE, TRAFFIC_CAR_SIZE
from simulator.vehicle.state import CarState
from simulator.world.world import World

STATION_M: Final = 3.0
MAX_STATIONS: Final = 6000


def scene_message(road: Road, *, controls: bool) -> str:
    """Return the constant data of a road as JSON; `controls`: whether browsers may drive and
    pause."""
    track = road.track
    count = min(math.ceil(track.length_m / STATION_M), MAX_STATIONS)
    pose = track.at(np.arange(count) * track.length_m / count)
    scene = {
        "type": "scene",
        "track": track.name,
        "length_m": round(track.length_m, 2),
        "lanes": road.lanes,
        "x": np.round(pose.x, 2).tolist(),
        "y": np.round(pose.y, 2).tolist(),
        "heading": np.round(pose.heading, 4).tolist(),
        "markings": road.markings_y.tolist(),
        "half_asphalt": road.half_asphalt,
        "edge": road.edge,
        "beam_angles": np.round(BEAM_ANGLES, 5).tolist(),
        "range_m": RANGE_M,
        "car": EGO_CAR_SIZE[:2],
        "other": TRAFFIC_CAR_SIZE[:2],
        "views": list(VIEWS),
        "lights": list(KINDS),
        "controls": controls,
    }
    return json.dumps(scene, allow_nan=False)


def state_message(world: World, **about: Any) -> str:
    """Return the state of car and surroundings as JSON; `about` adds values such as the score."""
    now = world.state
    features = world.features()
    state = {
        "type": "state",
        **_car(now),
        "beams": np.round(np.asarray(read_range(world)), 2).tolist(),
        "traffic": np.round(world.traffic.poses()[:, (0, 1, 5)], 3).tolist(),
        "heading_class": features.heading.name.lower(),
        "distances_m": {
            name: _rounded(getattr(features, name)) for name in ("ml", "mr", "l", "m", "r")
        },
        **about,
    }
    return json.dumps(state, allow_nan=False)


def _car(now: CarState) -> dict[str, Any]:
    return {
        "time_s": round(now.time_s, 3),
        "lap": now.lap,
        "lap_time_s": round(now.lap_time_s, 2),
        "s": round(now.s, 2),
        "x": round(now.x, 3),
        "y": round(now.y, 3),
        "yaw": round(now.yaw, 5),
        "to_middle": round(now.to_middle, 3),
        "angle": round(now.angle, 5),
        "speed_kmh": round(now.speed_kmh, 2),
        "steer": round(now.steer, 4),
        "gear": now.gear,
        "rpm": round(now.rpm),
    }


def _rounded(value: float | None) -> float | None:
    return None if value is None else round(value, 3)
