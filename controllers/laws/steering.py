"""Converts a front wheel angle to a steering action; left is positive in both."""

from runtime.jit import callable_from_compiled
from simulator.vehicle.car import CarParameters

STEERING_LOCK = CarParameters.steering_lock
"""Angle (rad) of the front wheels at the steering action 1."""


@callable_from_compiled
def steer_for(wheel_angle: float) -> float:
    """Return the steering action in [-1, 1] for a front wheel angle (rad)."""
    return max(-1.0, min(1.0, wheel_angle / STEERING_LOCK))
