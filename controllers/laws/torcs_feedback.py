"""The state feedback that drove the reference laps of the real TORCS.

front wheel angle (rad) = -(1.0 d + 0.1 (vy + vx sin theta) + 2.0 theta + 0.1 yaw rate)

The law has no model and no feed-forward. It validates the simulated car: under the same law the
simulator must drive the same laps as TORCS.
"""

import math
from dataclasses import dataclass

from controllers.interface import LoopConfig, Observation
from controllers.laws.steering import steer_for


def make_torcs(loop: LoopConfig) -> "StateFeedback":
    """The law, which does not depend on the control loop."""
    return StateFeedback()


@dataclass(frozen=True)
class StateFeedback:
    """Gains in rad of the front wheels per m, m/s, rad and rad/s."""

    offset: float = 1.0
    offset_rate: float = 0.1
    heading: float = 2.0
    yaw_rate: float = 0.1

    def update(self, observation: Observation) -> float:
        theta = -observation.angle
        rate = observation.vy + observation.vx * math.sin(theta)
        return steer_for(
            -(
                self.offset * observation.to_lane_centre
                + self.offset_rate * rate
                + self.heading * theta
                + self.yaw_rate * observation.yaw_rate
            )
        )
