"""The physical sensors of the paper's table, in its units; v_x and v_y signed, body frame."""

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from simulator.sensors.beams import BEAM_ANGLES, RANGE_M, shorten_at_boxes, track_beams
from simulator.sensors.sensor import Sensor
from simulator.track.kernel import index_at
from simulator.traffic import SIZE
from simulator.world import World

KMH = 3.6  # km/h in a m/s


def read_track_range(world: World) -> NDArray[np.float64]:
    """Distances (19,) m to the track's edge from +90 to -90 deg, in [0, 200]; -1 off the track."""
    now, table = world.state, world.road.track.arrays()
    piece = index_at(table, now.s)
    return track_beams(table, piece, now.x, now.y, now.yaw, BEAM_ANGLES, world.road.edge)


def read_range(world: World) -> NDArray[np.float64]:
    """As `read_track_range`, but a beam also ends at a traffic car."""
    distances = read_track_range(world)
    if world.traffic.count and distances[0] >= 0.0:
        now = world.state
        poses = world.traffic.poses()
        shorten_at_boxes(distances, now.x, now.y, now.yaw, BEAM_ANGLES, poses, SIZE[0], SIZE[1])
    return distances


def wheel(index: int) -> Callable[[World], float]:
    return lambda world: world.state.wheel_spin[index]


STANDARD: tuple[Sensor, ...] = (
    Sensor("range", "m", read_track_range, limits=(0.0, RANGE_M)),
    Sensor("range_traffic", "m", read_range, limits=(0.0, RANGE_M)),
    Sensor("angle", "rad", lambda world: world.state.angle),
    Sensor("speed", "km/h", lambda world: KMH * world.state.speed),
    Sensor("v_x", "km/h", lambda world: KMH * world.state.vx),
    Sensor("v_y", "km/h", lambda world: KMH * world.state.vy),
    Sensor("engine", "rpm", lambda world: world.state.rpm),
    Sensor("odometer", "m", lambda world: world.state.odometer_m),
    Sensor("lap_timer", "s", lambda world: world.state.lap_time_s),
    Sensor("wheel_spin_front_left", "rad/s", wheel(0)),
    Sensor("wheel_spin_front_right", "rad/s", wheel(1)),
    Sensor("wheel_spin_rear_left", "rad/s", wheel(2)),
    Sensor("wheel_spin_rear_right", "rad/s", wheel(3)),
)


def camera_sensor(camera: Any, view: str = "front") -> Sensor:
    """The image (H, W, 3) uint8 of a `simulator.camera.Camera` as a sensor named after its view."""
    return Sensor(
        f"camera_{view}",
        "RGB",
        lambda world: np.asarray(camera.render(world.body_pose(), world.traffic.poses(), view)),
    )
