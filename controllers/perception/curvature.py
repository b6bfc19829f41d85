"""Estimates the curvature of the road from the car's motion, for a perception that does not measure
the curvature."""

from dataclasses import dataclass

from controllers.interface import Observation
from runtime.jit import callable_from_compiled
from trackfeatures import RoadClass

SLOWEST_M_S = 3.0
"""Lower bound of the speed that divides the yaw rate."""
LEFT, RIGHT = int(RoadClass.LEFT), int(RoadClass.RIGHT)


@callable_from_compiled
def next_curvature(
    value: float, yaw_rate: float, vx: float, heading: float, dt: float, filter_s: float
) -> float:
    """Return the estimated curvature (1/m, left positive) of the road after a control step of
    `dt` s.

    `value` is the estimate before the step. The estimate is `yaw_rate` (rad/s) over `vx` (m/s, at
    least 3), low-pass filtered with the time constant `filter_s` (s). It is not negative where the
    class of the road, `heading`, is left, and not positive where the class is right.
    """
    turning = yaw_rate / max(vx, SLOWEST_M_S)
    value += dt / (dt + filter_s) * (turning - value)
    if heading == LEFT:
        value = max(value, 0.0)
    elif heading == RIGHT:
        value = min(value, 0.0)
    return value


@dataclass
class CurvatureEstimate:
    """The road's curvature (1/m, left positive), estimated by `next_curvature`.

    `dt` is the control step and `filter_s` the time constant of the filter, both in s.
    """

    dt: float
    filter_s: float = 0.4
    value: float = 0.0

    def __call__(self, observation: Observation) -> float:
        """Return the estimate (1/m) after the control step of `observation`."""
        yaw_rate, vx, heading = observation.yaw_rate, observation.vx, observation.heading
        self.value = next_curvature(self.value, yaw_rate, vx, heading, self.dt, self.filter_s)
        return self.value
