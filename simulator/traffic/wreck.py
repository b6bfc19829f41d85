"""A traffic car that was hit: a rigid body with wheels and applied brakes, until it is at rest.

Other traffic treats it as an obstacle and stops behind it. World frame, SI units.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from runtime.jit import compiled
from simulator.arrays import FloatArray
from simulator.track.piece_table import Table, index_at
from simulator.vehicle.car import RPM, CarParameters
from simulator.vehicle.dynamics import ENGINE, MEMORY, PIECE, SPIN, compute_forces
from simulator.vehicle.orientation import rotation
from simulator.vehicle.surface import Ground
from simulator.vehicle.track_state import (
    ANGLE,
    PITCH,
    ROLL,
    TRACK_OFFSET,
    TRACK_S,
    TRACK_SPEED,
    TRACK_STATE_SIZE,
    YAW,
    measure_track_state,
)

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
"""Parameters of the traffic cars: an ordinary passenger car without wings, on road tyres."""

BRAKE = 0.6
CG_HEIGHT = TRAFFIC_CAR.cg_height
AT_REST_M_S, AT_REST_RAD_S = 0.05, 0.05
_CONTROLS = np.array([0.0, 0.0, BRAKE, 0.0])


@dataclass
class Wreck:
    """One struck car, `moving` until it is at rest. `motion` (13,) is position, quaternion (x, y,
    z, w), velocity and angular velocity in the world frame; `memory` (8,) is the car's internal
    state (see `dynamics`)."""

    row: int
    """Index of the car in the traffic."""
    motion: FloatArray
    memory: FloatArray
    moving: bool = True

    @classmethod
    def from_traffic(
        cls, row: int, motion: FloatArray, s: float, speed: float, table: Table
    ) -> "Wreck":
        """Make a wreck of traffic car `row`, which drove `speed` m/s at `s` m. `motion` (13,) is
        the array in which the caller stores the car's motion after the impact."""
        memory = np.zeros(MEMORY)
        memory[PIECE] = index_at(table, s)
        memory[SPIN : SPIN + 4] = speed / TRAFFIC_CAR.wheel_radius
        memory[ENGINE] = TRAFFIC_CAR.idle_rpm / RPM
        return cls(row, motion, memory)

    def forces(self, params: NDArray[Any], table: Table, ground: Ground) -> FloatArray:
        """Return the force and torque (6,) (N, N m, world frame) of road, air and gravity on the
        wreck for the next physics step. `params` are the traffic car's parameters, `table` is the
        track's table."""
        wrench = np.empty(6)
        compute_forces(params, table, ground, self.motion, self.memory, _CONTROLS, wrench)
        return wrench

    def update_rest(self) -> None:
        """Set `moving` to whether the car is faster than 0.05 m/s or turns faster than 0.05 rad/s.
        If `moving` is false, set the velocity and the angular velocity to zero."""
        slow = np.linalg.norm(self.motion[7:10]) < AT_REST_M_S
        self.moving = not (slow and np.linalg.norm(self.motion[10:13]) < AT_REST_RAD_S)
        if not self.moving:
            self.motion[7:13] = 0.0

    def pose_for_traffic(self, table: Table) -> tuple[FloatArray, FloatArray]:
        """Return the pose (x, y, z, roll, pitch, yaw) of the ground point under the wreck, and (s,
        to_middle, angle, speed along the track)."""
        readings = np.empty(TRACK_STATE_SIZE)
        measure_track_state(table, self.motion, self.memory, readings)
        up = rotation(self.motion[3:7])[2]
        pose = np.empty(6)
        pose[:3] = self.motion[:3] - up * TRAFFIC_CAR.cg_height
        pose[3:] = readings[[ROLL, PITCH, YAW]]
        return pose, readings[[TRACK_S, TRACK_OFFSET, ANGLE, TRACK_SPEED]]


@compiled
def lane_motion(
    pose: FloatArray, move: FloatArray, share: float, dt: float, motion: FloatArray
) -> None:
    """Fill `motion` (13,) (position, quaternion, velocity, angular velocity) of a traffic car in
    its lane. `pose` (6,) is its ground pose at the start of a control step of `dt` s, `move` (6,)
    the change of the pose over the step, `share` the fraction of the step already done."""
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
