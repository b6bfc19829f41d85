"""The command to a car and the state of a car. SI units; angles in rad, counter-clockwise."""

import math
from dataclasses import dataclass
from typing import Literal

Collision = Literal["traffic", "wall"]


@dataclass(frozen=True, slots=True)
class Command:
    """A command to the car: the paper's four actuators."""

    steer: float = 0.0
    """Steering in [-1, 1], left positive; times the steering lock it is the front-wheel angle."""
    throttle: float = 0.0
    """Throttle in [0, 1]."""
    brake: float = 0.0
    """Brake in [0, 1]."""
    gear: int = 1
    """Gear: -1 reverse, 0 neutral, 1 to 6."""


@dataclass(frozen=True, slots=True)
class CarState:
    """The state of the car at one time; x, y, z is its centre of gravity in the world frame (m)."""

    time_s: float
    x: float
    y: float
    z: float
    yaw: float
    pitch: float
    """Angle about the body's y axis (left), rad, positive nose down."""
    roll: float
    vx: float
    """Velocity along the body, m/s, forward positive."""
    vy: float
    """Velocity to the body's left, m/s."""
    yaw_rate: float
    s: float
    """Distance along the centre line, m, in [0, length of the lap)."""
    to_middle: float
    """Lateral offset from the centre line, m, left positive."""
    angle: float
    """Heading angle: track tangent minus yaw, rad, in (-pi, pi]."""
    curvature: float
    """Curvature of the centre line at the car, 1/m, left positive."""
    rpm: float
    gear: int
    wheel_spin: tuple[float, float, float, float]
    """Wheel speeds, rad/s: front left, front right, rear left, rear right."""
    steer: float
    """Actual front-wheel angle as a fraction of the lock; it lags behind the command."""
    lap: int
    odometer_m: float
    lap_time_s: float
    collision: Collision | None
    """What the body touched during the last control step; None if nothing."""
    off_track: bool
    backwards: bool

    @property
    def speed(self) -> float:
        """Speed in the road plane, m/s; negative if the car rolls backwards."""
        return speed_of(self.vx, self.vy)

    @property
    def speed_kmh(self) -> float:
        return 3.6 * self.speed


def speed_of(vx: float, vy: float) -> float:
    """Return the speed (m/s) in the road plane from the velocities `vx` (forward) and `vy` (left)
    in the body frame (m/s). It is negative if the car rolls backwards."""
    # math.hypot, because hypot of compiled code and of numpy differs in the last bits.
    planar = math.hypot(vx, vy)
    return planar if vx >= 0.0 else -planar
