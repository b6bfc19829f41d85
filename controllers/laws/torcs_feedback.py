"""The state feedback that drove the reference laps of the real TORCS.

front wheel angle (rad) = -(1.0 d + 0.1 (vy + vx sin theta) + 2.0 theta + 0.1 yaw rate)

The law has no model and no feed-forward. It validates the simulated car: under the same law the
simulator must drive the same laps as TORCS.
"""

import math
from dataclasses import dataclass

import numpy as np

from controllers.interface import (
    ANGLE,
    TO_LANE_CENTRE,
    VX,
    VY,
    YAW_RATE,
    LoopConfig,
    Observation,
    Observations,
)
from controllers.laws.lateral_model import Matrix
from controllers.laws.steering import steer_for
from runtime.jit import compiled_for_threads


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
        return float(self.update_batch(Observations.of(observation))[0])

    def update_batch(self, observations: Observations) -> Matrix:
        gains = (self.offset, self.offset_rate, self.heading, self.yaw_rate)
        return feed_back(observations.rows, gains)


@compiled_for_threads
def feed_back(seen: Matrix, gains: tuple[float, float, float, float]) -> Matrix:
    """The steering actions (N,) for the rows of `Observations` (N, OBSERVED)."""
    steers = np.empty(len(seen))
    offset, offset_rate, heading, yaw_rate = gains
    for k in range(len(seen)):
        theta = -seen[k, ANGLE]
        rate = seen[k, VY] + seen[k, VX] * math.sin(theta)
        steers[k] = steer_for(
            -(
                offset * seen[k, TO_LANE_CENTRE]
                + offset_rate * rate
                + heading * theta
                + yaw_rate * seen[k, YAW_RATE]
            )
        )
    return steers
