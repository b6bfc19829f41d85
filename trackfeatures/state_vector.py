"""The state vector (7,) of car and road that the controllers of Li et al. (see `definitions`)
receive."""

import math

import numpy as np
from numpy.typing import NDArray

from trackfeatures.road_class import RoadClass

STATE_SIZE = 7
SPEED_SCALE_M_S = 75.0 / 3.6


def state_vector(
    offset: float, angle: float, vx: float, vy: float, heading: RoadClass, half_width: float
) -> NDArray[np.float64]:
    """Return the vector (7,): offset / half_width, angle / pi, vx / 75 km/h, vy / 75 km/h, and the
    class of the road one-hot (left, straight, right).

    `offset` is the car's lateral offset (m, left positive), `half_width` half of the track's width
    (m), `angle` the heading angle (rad), and `vx` and `vy` are the car's speeds (m/s).
    """
    vector = np.zeros(STATE_SIZE)
    vector[0], vector[1] = offset / half_width, angle / math.pi
    vector[2], vector[3] = vx / SPEED_SCALE_M_S, vy / SPEED_SCALE_M_S
    vector[4 + heading] = 1.0
    return vector
