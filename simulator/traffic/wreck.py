"""A traffic car that was hit: no longer a thought on a lane but a body with wheels, its brakes on.

It slides, turns and pushes others until it rests; traffic behind it sees it and stops.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from runtime.jit import compiled
from simulator.track.kernel import Table, index_at
from simulator.vehicle.car import RPM, CarParameters
from simulator.vehicle.dynamics import ENGINE, MEMORY, PIECE, SPIN, advance
from simulator.vehicle.orientation import rotation
from simulator.vehicle.surface import Ground
from simulator.vehicle.track_state import (
    ALONG,
    ANGLE,
    OFFSET,
    PITCH,
    PLACE,
    READINGS,
    ROLL,
    YAW,
    read_out,
)

FloatArray = NDArray[np.float64]

TRAFFIC_CAR = CarParameters(
    mass=1200.0,
    fuel=40.0,
    inertia=(550.0, 2000.0, 2200.0),
    cg_height=0.5,
    length=4.4,
    width=1.8,
    height=1.4,
    front_track=1.55,
    rear_track=1.55,
    friction=0.9,
    spring_front=40_000.0,
    spring_rear=40_000.0,
    damper_front=3_000.0,
    damper_rear=3_000.0,
    wing_drag=0.0,
    lift_front=0.0,
    lift_rear=0.0,
)
"""What the cars of the traffic are as bodies: an ordinary car, without wings and on road tyres."""

BRAKE = 0.6
CG_HEIGHT = TRAFFIC_CAR.cg_height
AT_REST_M_S, AT_REST_RAD_S = 0.05, 0.05
_CONTROLS = np.array([0.0, 0.0, BRAKE, 0.0])


@dataclass
class Wreck:
    """One struck car; `moving` until it has come to rest."""

    row: int
    """Which of the traffic's cars it is."""
    motion: FloatArray
    memory: FloatArray
    moving: bool = True

    @classmethod
    def of(cls, row: int, motion: FloatArray, s: float, speed: float, table: Table) -> "Wreck":
        """The car of `row`, which drove `speed` m/s at `s` and has got this motion by the blow."""
        memory = np.zeros(MEMORY)
        memory[PIECE] = index_at(table, s)
        memory[SPIN : SPIN + 4] = speed / TRAFFIC_CAR.wheel_radius
        memory[ENGINE] = TRAFFIC_CAR.idle_rpm / RPM
        return cls(row, motion, memory)

    def forces(self, params: NDArray[Any], table: Table, ground: Ground) -> FloatArray:
        """(force, torque) (6,) of road, air and weight over the next physics step."""
        wrench = np.empty(6)
        advance(params, table, ground, self.motion, self.memory, _CONTROLS, wrench)
        return wrench

    def settle(self) -> None:
        """Note whether it has come to rest, and hold it there if so."""
        slow = np.linalg.norm(self.motion[7:10]) < AT_REST_M_S
        self.moving = not (slow and np.linalg.norm(self.motion[10:13]) < AT_REST_RAD_S)
        if not self.moving:
            self.motion[7:13] = 0.0

    def seen(self, table: Table) -> tuple[FloatArray, FloatArray]:
        """What the traffic sees of it: (ground pose (6,), (s, left positive offset, angle, speed
        along the track))."""
        readings = np.empty(READINGS)
        read_out(table, self.motion, self.memory, readings)
        up = rotation(self.motion[3:7])[2]
        pose = np.empty(6)
        pose[:3] = self.motion[:3] - up * TRAFFIC_CAR.cg_height
        pose[3:] = readings[[ROLL, PITCH, YAW]]
        return pose, readings[[PLACE, OFFSET, ANGLE, ALONG]]


@compiled
def path_motion(
    pose: FloatArray, move: FloatArray, share: float, dt: float, motion: FloatArray
) -> None:
    """Motion (13,) of a traffic car that goes its way: `share` of `move` (6,) beyond its ground
    `pose` (6,) at the start of a control step of `dt` s."""
    roll = 0.5 * (pose[3] + share * move[3])
    pitch = 0.5 * (pose[4] + share * move[4])
    yaw = 0.5 * (pose[5] + share * move[5])
    cr, sr = np.cos(roll), np.sin(roll)
    cp, sp = np.cos(pitch), np.sin(pitch)
    cy, sy = np.cos(yaw), np.sin(yaw)
    motion[3] = sr * cp * cy - cr * sp * sy
    motion[4] = cr * sp * cy + sr * cp * sy
    motion[5] = cr * cp * sy - sr * sp * cy
    motion[6] = cr * cp * cy + sr * sp * sy
    up = rotation(motion[3:7])[2]
    for i in range(3):
        motion[i] = pose[i] + share * move[i] + up[i] * CG_HEIGHT
        motion[7 + i] = move[i] / dt
    motion[10], motion[11], motion[12] = 0.0, 0.0, move[5] / dt
