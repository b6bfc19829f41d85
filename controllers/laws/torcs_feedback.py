"""The state feedback that drove the laps recorded in TORCS, to which the simulated car is compared.

front wheel angle (rad) = -(1.0 d + 0.1 (vy + vx sin theta) + 2.0 theta + 0.1 yaw rate)

with the offset d (m, left positive), the speeds vx and vy (m/s, body frame), the heading error
theta (rad, counter-clockwise) and the yaw rate (rad/s). The law has no model and no feed-forward.
With the same law the simulated car must drive the same laps as the car of TORCS.
"""

import math

import numpy as np

from controllers.interface import (
    ANGLE,
    TO_LANE_CENTRE,
    VX,
    VY,
    YAW_RATE,
    BatchController,
    LoopConfig,
    Observations,
)
from controllers.laws.lateral_model import Matrix
from controllers.laws.steering import steer_for
from runtime.jit import compiled_for_threads

OFFSET, OFFSET_RATE, HEADING_ERROR, TURN = 1.0, 0.1, 2.0, 0.1
"""Gains in rad of the front wheels per m, m/s, rad and rad/s."""


def make_torcs(loop: LoopConfig) -> "StateFeedback":
    """Make a `StateFeedback`; it does not depend on `loop`."""
    return StateFeedback()


class StateFeedback(BatchController):
    """Steers by constant gains on the offset, its rate of change, the heading error and the yaw
    rate."""

    def update_batch(self, observations: Observations) -> Matrix:
        return feed_back(observations.rows)


@compiled_for_threads
def feed_back(seen: Matrix) -> Matrix:
    """Return the steering actions (N,) for `seen` (N, 7), the rows of `Observations`."""
    steers = np.empty(len(seen))
    for k in range(len(seen)):
        theta = -seen[k, ANGLE]
        rate = seen[k, VY] + seen[k, VX] * math.sin(theta)
        steers[k] = steer_for(
            -(
                OFFSET * seen[k, TO_LANE_CENTRE]
                + OFFSET_RATE * rate
                + HEADING_ERROR * theta
                + TURN * seen[k, YAW_RATE]
            )
        )
    return steers
