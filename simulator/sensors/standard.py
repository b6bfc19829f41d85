"""The sensors of the table of sensors in the paper (Li et al.), with the ranges and units of that
table.

v_x and v_y are signed components in the body frame, so their limits are signed too. Speed and wheel
spin are magnitudes, as in the table.
"""

import math
from collections.abc import Callable, Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from simulator.sensors.beams import (
    BEAM_ANGLES,
    OFF_TRACK,
    RANGE_M,
    shorten_at_boxes,
    track_beams,
)
from simulator.sensors.sensor import Sensor
from simulator.track.piece_table import index_at
from simulator.track.road import BRIDGE_M
from simulator.traffic.traffic import TRAFFIC_CAR_SIZE
from simulator.world.world import World
from trackfeatures.errors import UserError

KMH = 3.6  # km/h per m/s
CAMERA = "camera"
"""Name of the camera sensor, the only sensor that needs a `simulator.camera.Camera`."""


def read_track_range(world: World) -> NDArray[np.float64]:
    """Return the distances (19,) m to the track's edge along beams from +90 (left) to -90 deg from
    the car's heading, at most 200 m; -1 if the car is off the track."""
    now, table = world.state, world.road.track.arrays()
    distances = np.empty(len(BEAM_ANGLES))
    piece = index_at(table, now.s)
    track_beams(table, piece, now.x, now.y, now.yaw, BEAM_ANGLES, world.road.edge, distances)
    return distances


def read_range(world: World) -> NDArray[np.float64]:
    """Return the distances (19,) m to the track's edge or to a traffic car, whichever is nearer,
    along the beams of `read_track_range`; -1 if the car is off the track."""
    distances = read_track_range(world)
    if world.traffic.count and distances[0] >= 0.0:
        now = world.state
        poses = world.traffic.poses()
        poses = poses[~_on_other_level(world, poses)]
        length, width, _ = TRAFFIC_CAR_SIZE
        shorten_at_boxes(distances, now.x, now.y, now.yaw, BEAM_ANGLES, poses, length, width)
    return distances


def _on_other_level(world: World, poses: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return a mask (n,) of the cars at `poses` (n, 6), m, rad, that are on a bridge over the
    road of the world's car, or on the road below its bridge."""
    track, s = world.road.track, world.state.s
    other = np.abs(poses[:, 2] - track.at(s).z) > BRIDGE_M
    for k in np.flatnonzero(other):
        x, y, z = poses[k, :3]
        at, offset = track.project(x, y, s)
        other[k] = abs(z - float(track.at(at, offset).z)) > BRIDGE_M
    return np.asarray(other)


def range_meter(name: str, read: Callable[[World], NDArray[np.float64]]) -> Sensor:
    limits, shape = (0.0, RANGE_M), BEAM_ANGLES.shape
    return Sensor(name, "m", read, limits=limits, invalid=OFF_TRACK, shape=shape)


def wheel_meter(name: str, index: int) -> Sensor:
    def read(world: World) -> float:
        return abs(world.state.wheel_spin[index])

    return Sensor(name, "rad/s", read, limits=(0.0, math.inf))


STANDARD: tuple[Sensor, ...] = (
    range_meter("range", read_track_range),
    range_meter("range_traffic", read_range),
    Sensor("angle", "rad", lambda world: world.state.angle, limits=(-math.pi, math.pi)),
    Sensor("speed", "km/h", lambda world: abs(KMH * world.state.speed), limits=(0.0, 200.0)),
    Sensor("v_x", "km/h", lambda world: KMH * world.state.vx, limits=(-200.0, 200.0)),
    Sensor("v_y", "km/h", lambda world: KMH * world.state.vy, limits=(-50.0, 50.0)),
    Sensor("engine", "rpm", lambda world: world.state.rpm, limits=(0.0, 10_000.0)),
    Sensor("odometer", "m", lambda world: world.state.odometer_m, limits=(0.0, math.inf)),
    Sensor("lap_timer", "s", lambda world: world.state.lap_time_s, limits=(0.0, math.inf)),
    wheel_meter("wheel_spin_front_left", 0),
    wheel_meter("wheel_spin_front_right", 1),
    wheel_meter("wheel_spin_rear_left", 2),
    wheel_meter("wheel_spin_rear_right", 3),
)
"""The sensors of the paper's table except the camera (see `camera_sensor`)."""


def camera_sensor(camera: Any, view: str = "front") -> Sensor:
    """Return a sensor that reads the image (H, W, 3) uint8 of a `simulator.camera.Camera`.

    The sensor's name is `camera` for the view `front`, and `camera_VIEW` for all other views.
    """

    def read(world: World) -> NDArray[np.uint8]:
        return np.asarray(camera.render(world.body_pose(), world.traffic.poses(), view))

    name = CAMERA if view == "front" else f"{CAMERA}_{view}"
    return picture_sensor(name, read, (camera.height, camera.width, 3))


def picture_sensor(
    name: str, read: Callable[[World], NDArray[np.uint8]], shape: tuple[int, int, int]
) -> Sensor:
    """Return a sensor that reads uint8 images of `shape` (H, W, 3); `read` returns the image of a
    world."""
    return Sensor(name, "-", read, limits=(0.0, 255.0), shape=shape, dtype="uint8")


def sensors_of(chosen: Iterable[str | Sensor]) -> tuple[Sensor, ...]:
    """Return `chosen` with each name replaced by the sensor of this name in STANDARD. Raises
    UserError for an unknown name."""
    return tuple(sensor if isinstance(sensor, Sensor) else _named(sensor) for sensor in chosen)


def _named(name: object) -> Sensor:
    for sensor in STANDARD:
        if sensor.name == name:
            return sensor
    raise UserError(
        f"unknown sensor {name!r}; the sensors are {', '.join(s.name for s in STANDARD)} and "
        f"{CAMERA}, or give a Sensor of your own"
    )
