"""Dataclasses of one recorded frame: the image, its labels and the state of the simulation.

World frame: x, y in the plane, z up, angles counter-clockwise, SI units.
"""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

import trackfeatures as tf


@dataclass(frozen=True, slots=True)
class EgoState:
    """Pose of the car's centre of gravity (m, rad), its velocities in the body frame (m/s, rad/s),
    and the share of the road within 30 m ahead that is in shadow."""

    x: float
    y: float
    z: float
    yaw: float
    pitch: float
    roll: float
    vx: float
    vy: float
    yaw_rate: float
    shadow_fraction: float = 0.0


@dataclass(frozen=True, slots=True)
class SensorReadings:
    """Readings of the paper's sensors in its units: distances in m, angle in rad, speeds in km/h,
    engine rotation in rev/min, lap time in s, wheel spin in rad/s."""

    range: tuple[float, ...] = ()
    angle: float = 0.0
    speed: float = 0.0
    speed_x: float = 0.0
    speed_y: float = 0.0
    engine_rotation: float = 0.0
    odometer: float = 0.0
    lap_time: float = 0.0
    wheel_spin: tuple[float, ...] = ()


@dataclass(frozen=True, slots=True)
class DriverCommand:
    """The driver's command: steer in [-1, 1], left positive; throttle and brake in [0, 1]."""

    steer: float
    throttle: float
    brake: float
    gear: int


@dataclass(frozen=True, slots=True)
class RoadPlace:
    """Position of the car on the road: `lane_index` 0 is the leftmost lane; curvature in 1/m, left
    positive; `to_middle` (left positive) and `s` in m."""

    lanes: int
    lane_index: int
    curvature: float
    to_middle: float
    s: float


@dataclass(frozen=True, slots=True)
class Frame:
    """A recorded frame. `image` is (H, W, 3) uint8 RGB. `traffic` (n, 6) is x, y, z (m), roll,
    pitch, yaw (rad) of each of the n other cars. `markings` are the visible lane markings as
    polylines (k, 2) in pixels."""

    image: NDArray[np.uint8]
    features: tf.TrackFeatures
    place: RoadPlace
    ego: EgoState
    command: DriverCommand
    sensors: SensorReadings = field(default_factory=SensorReadings)
    traffic: NDArray[np.float64] = field(default_factory=lambda: np.zeros((0, 6)))
    markings: tuple[NDArray[np.float64], ...] = ()
