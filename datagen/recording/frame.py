"""One control step as it is recorded: the image, its labels and the state of the simulation.

World frame: x, y in the plane, z up, angles counter-clockwise, SI units.
"""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

import trackfeatures as tf


@dataclass(frozen=True, slots=True)
class EgoState:
    """Pose of the centre of gravity, velocities in the body frame (m, rad, m/s, rad/s)."""

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
    """The paper's sensors in the paper's units (speeds in km/h, rotation in rev/min)."""

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
    """Control inputs of the step: steer in [-1, 1], left positive; throttle and brake in [0, 1]."""

    steer: float
    throttle: float
    brake: float
    gear: int


@dataclass(frozen=True, slots=True)
class RoadPlace:
    """Position of the car on the road: curvature in 1/m, `to_middle` and `s` in m."""

    lanes: int
    lane_index: int
    curvature: float
    to_middle: float
    s: float


@dataclass(frozen=True, slots=True)
class Frame:
    """`image` (H, W, 3) uint8 RGB; `traffic` (n, 6): x, y, z, roll, pitch, yaw of each other car.

    `markings` are the visible lane markings as polylines in pixels, (k, 2) each.
    """

    image: NDArray[np.uint8]
    features: tf.TrackFeatures
    place: RoadPlace
    ego: EgoState
    command: DriverCommand
    sensors: SensorReadings = field(default_factory=SensorReadings)
    traffic: NDArray[np.float64] = field(default_factory=lambda: np.zeros((0, 6)))
    markings: tuple[NDArray[np.float64], ...] = ()
