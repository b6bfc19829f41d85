"""The privileged state: numbers of each car that PPO's critic receives in addition to the actor's
state.

Only the training needs a critic, so its input can contain more than the actor's (an asymmetric
actor-critic: Pinto et al. 2018). The actor's state is noisy and late, and does not contain the
curvature of the road. If the critic received only the actor's state, it would attribute the effect
of a bend to the action before the bend.
"""

import numpy as np
from numpy.typing import NDArray

from controllers.drive.config import THROTTLE
from runtime.jit import compiled
from simulator.arrays import FloatArray
from simulator.track.piece_table import CURVATURE, index_near
from simulator.vehicle.car import CarParameters
from simulator.vehicle.dynamics import PIECE
from simulator.vehicle.track_state import ANGLE, TRACK_OFFSET, TRACK_S, VX, VY, YAW_RATE
from simulator.world.fleet import (
    COMMAND_AT,
    HALF_WIDTH,
    MEMORY_AT,
    ROAD,
    TABLE_BEGIN,
    TABLE_END,
    TRACK_AT,
    Fleet,
)

AHEAD_M = (0.0, 5.0, 10.0, 15.0, 20.0, 30.0, 40.0, 60.0, 80.0)
"""Distances (m) along the road, ahead of the car, at which the state contains the curvature."""
PARTS = (
    *("d", "angle", "v_x", "v_y", "yaw_rate", "steering", "half_width"),
    *(f"curvature_{ahead:g}" for ahead in AHEAD_M),
    *("friction", "mass", "throttle", "delay", "noise"),
)
"""Names of the numbers of the privileged state. `throttle` is the difference from THROTTLE;
`friction` and `mass` are relative differences from the car's default parameters. SI units, `delay`
in control steps."""
SPREAD = np.array(
    (
        *(0.5, 0.04, 20.0, 0.8, 0.4, 0.3, 5.5),
        *((0.02,) * len(AHEAD_M)),
        *(0.2, 0.15, 0.1, 1.0, 1.0),
    ),
    np.float32,
)
"""Typical size of each number. The number is divided by it."""
SIZE = len(PARTS)
FRICTION_AT = PARTS.index("friction")
_AHEAD = np.array(AHEAD_M)


def privileged_state(
    fleet: Fleet,
    throttle: NDArray[np.float64],
    delay: NDArray[np.int64],
    noise: NDArray[np.float64],
) -> NDArray[np.float32]:
    """Return the privileged states (N, 21) of the cars of `fleet`: the numbers that `PARTS` names,
    each divided by its typical size.

    The arguments are arrays (N,): `throttle` in [0, 1], `delay` of the perception in control steps,
    and `noise` in [0, 1], the factor on the standard deviations of the sensor noise
    (`controllers.drive.disturbance`). For a car with image errors (`cars.IMAGE_ERRORS`) `noise` is
    1.
    """
    found = np.zeros((len(fleet.cars), SIZE), np.float32)
    cars, _, _, tables, _, _, roads, _, _ = fleet.arrays
    _fill(cars, tables, roads, _AHEAD, found)
    friction = fleet.params["friction"] / CarParameters.friction - 1.0
    mass = fleet.params["mass"] / CarParameters.mass - 1.0
    for k, column in enumerate((friction, mass, throttle - THROTTLE, delay, noise)):
        found[:, FRICTION_AT + k] = column
    return found / SPREAD


@compiled
def _fill(
    cars: FloatArray,
    tables: FloatArray,
    roads: FloatArray,
    ahead: FloatArray,
    out: NDArray[np.float32],
) -> None:
    for number in range(len(cars)):
        car, row = cars[number], out[number]
        road, track = roads[int(car[ROAD])], car[TRACK_AT:]
        row[0], row[1] = track[TRACK_OFFSET], track[ANGLE]
        row[2], row[3], row[4] = track[VX], track[VY], track[YAW_RATE]
        row[5], row[6] = car[COMMAND_AT], road[HALF_WIDTH]
        table = tables[int(road[TABLE_BEGIN]) : int(road[TABLE_END])]
        piece = int(car[MEMORY_AT + PIECE])
        for k in range(len(ahead)):
            piece = index_near(table, track[TRACK_S] + ahead[k], piece)
            row[7 + k] = table[piece, CURVATURE]
