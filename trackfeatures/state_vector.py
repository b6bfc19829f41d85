"""The paper's state vector (7,) of car and road, the input of its controllers."""

import math

import numpy as np
from numpy.typing import NDArray

from trackfeatures.road_class import RoadClass

STATE_SIZE = 7
SPEED_SCALE_M_S = 75.0 / 3.6


def state_vector(
    offset: float, angle: float, vx: float, vy: float, heading: RoadClass, half_width: float
) -> NDArray[np.float64]:
    """Return (7,): offset / half of the track's width, angle / pi, vx and vy / 75 km/h, and the
    class of the road one-hot (left, straight, right).

    `offset` and `half_width` are in m, `angle` in rad, `vx` and `vy` in m/s.
    """
    vector = np.zeros(STATE_SIZE)
    vector[0], vector[1] = offset / half_width, angle / math.pi
    vector[2], vector[3] = vx / SPEED_SCALE_M_S, vy / SPEED_SCALE_M_S
    vector[4 + heading] = 1.0
    return vector
