"""The road's curvature from the car's own motion, for laws on a perception that lacks it."""

from dataclasses import dataclass

from controllers.interface import Observation
from trackfeatures import RoadClass

SLOWEST_M_S = 3.0
"""Lower bound of the speed that divides the yaw rate."""


@dataclass
class CurvatureEstimate:
    """The road's curvature (1/m, left positive): yaw rate over speed, low-pass filtered.

    `dt` is the control step and `filter_s` the time constant of the filter, both in s.
    """

    dt: float
    filter_s: float = 0.4
    value: float = 0.0

    def __call__(self, observation: Observation) -> float:
        """The estimate after this step; its sign does not contradict the class of the road."""
        turning = observation.yaw_rate / max(observation.vx, SLOWEST_M_S)
        self.value += self.dt / (self.dt + self.filter_s) * (turning - self.value)
        if observation.heading is RoadClass.LEFT:
            self.value = max(self.value, 0.0)
        elif observation.heading is RoadClass.RIGHT:
            self.value = min(self.value, 0.0)
        return self.value
