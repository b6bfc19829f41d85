"""The fixed state feedback that drove the reference laps of the real TORCS.

front wheel angle (rad) = -(1.0 d + 0.1 (vy + vx sin theta) + 2.0 theta + 0.1 yaw rate)

Without model and feed-forward. It compares the simulated car with TORCS: the same law must drive
the same laps in both.
"""

import math
from dataclasses import dataclass

from controllers.interface import LoopConfig, Observation
from simulator.vehicle.car import CarParameters

STEERING_LOCK = CarParameters.steering_lock  # rad of the front wheels at steer = 1


def steer_for(wheel_angle: float, lock: float = STEERING_LOCK) -> float:
    """The steering action in [-1, 1] for a front wheel angle (rad)."""
    return max(-1.0, min(1.0, wheel_angle / lock))


def make_torcs(loop: LoopConfig) -> "StateFeedback":
    """The same law in every control loop."""
    return StateFeedback()


@dataclass(frozen=True)
class StateFeedback:
    """Gains: rad of the front wheels per m, m/s, rad and rad/s."""

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
