"""Forces of wheels, air and gravity on the car's body, in one compiled step of 1/200 s.

World frame z up; body frame x forward, y left, z up, origin at the centre of gravity. SI units. `p`
is the record `CarParameters.packed()[0]`; `axes` (3, 3) has the body axes as rows; `velocity` (6,)
is linear, then angular; `wrench` (6,) is force, then torque; all three are in the world frame. This
module computes the wrench; `rigid_body` or PyBullet moves the body.
"""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from runtime.jit import compiled, inlined
from simulator.arrays import FloatArray
from simulator.track.piece_table import Table, locate, surface
from simulator.vehicle.car import GRAVITY
from simulator.vehicle.orientation import fill_axes
from simulator.vehicle.powertrain import (
    clutch,
    free_engine_speed,
    gear_ratio,
    limit_shaft_speed,
)
from simulator.vehicle.surface import Ground
from simulator.vehicle.wheels import (
    ALONG,
    WHEEL,
    add_tyre_forces,
    locate_contacts,
    turn_wheels,
    tyre_slip_gains,
    update_loads,
)
from simulator.world.control_rate import PHYSICS_HZ

DT = 1.0 / PHYSICS_HZ

# Internal state of the car besides its body's motion, `memory` (MEMORY,): front-wheel angle (rad),
# engine speed (rad/s), four wheel speeds (rad/s), track piece of the last lookup, odometer (m).
STEER, ENGINE, SPIN, PIECE, ODOMETER, MEMORY = 0, 1, 2, 6, 7, 8
# A motion (MOTION,): position, quaternion (x, y, z, w), velocity, angular velocity; world frame.
MOTION = 13
UNDERBODY_CLEARANCE_M = 0.10
"""Height of the centre of gravity over the road (m) at which the underbody touches the road."""
UNDERBODY_SPRING, UNDERBODY_DAMPER = 500_000.0, 20_000.0


Work = tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]
"""Memory for one physics step, reused in the next: axes (3, 3), wheels (4, WHEEL), slip gains (4,),
velocity (6,), `turn_wheels`'s array (9,), wrench (6,)."""


@compiled
def make_work() -> Work:
    """Allocate the memory for the physics steps of one car."""
    work = (
        np.empty((3, 3)),
        np.empty((4, WHEEL)),
        np.empty(4),
        np.empty(6),
        np.empty(9),
        np.empty(6),
    )
    forget_turn(work)
    return work


@compiled
def forget_turn(work: Work) -> None:
    """Discard the wheel angles stored in `work`, which may be another car's, so that the next step
    computes them."""
    work[4][0] = math.nan


@inlined
def move_steering(p: Any, angle: float, command: float, dt: float) -> float:
    """Return the front-wheel angle (rad) after `dt` s of steering towards `command` in [-1, 1]."""
    step = p.steering_rate * dt
    wanted = command * p.steering_lock
    return float(angle + min(max(wanted - angle, -step), step))


@inlined
def apply_brake(spin: float, brake: float, inertia: float, dt: float) -> float:
    """Return the wheel speed (rad/s) after a brake torque `brake` (N m) has acted on a wheel of
    `inertia` (kg m2) and speed `spin` (rad/s) for `dt` s. The brake stops the wheel but never
    reverses it."""
    lost = brake * dt / inertia
    if spin > lost:
        return spin - lost
    if spin < -lost:
        return spin + lost
    return 0.0


@compiled
def update_wheel_speeds(
    p: Any, memory: FloatArray, command: FloatArray, wheels: FloatArray, slip_gain: FloatArray
) -> None:
    """Advance the four wheel speeds and the engine speed in `memory` (8,) by one step. The
    integration is implicit in the tyre force, because tyres are stiff.

    command (4,): steer, throttle, brake, gear; wheels (4, 20): see `wheels`; slip_gain (4,): tyre
    force per m/s of slip speed (N s/m).
    """
    r, gear = p.wheel_radius, int(command[3])
    ratio = gear_ratio(p, gear)
    brake = p.brake_torque * command[2]
    spin, along = memory[SPIN : SPIN + 4], wheels[:, ALONG]
    front_brake = 0.5 * brake * p.brake_front_share
    rear_brake = 0.5 * brake * (1.0 - p.brake_front_share)
    for wheel in range(2):
        drag = p.wheel_inertia + DT * r * r * slip_gain[wheel]
        free = (p.wheel_inertia * spin[wheel] + DT * r * slip_gain[wheel] * along[wheel]) / drag
        spin[wheel] = apply_brake(free, front_brake, drag, DT)
    torque, inertia = 0.0, 0.0
    if ratio == 0.0:
        memory[ENGINE] = free_engine_speed(p, memory[ENGINE], command[1], DT)
    else:
        shaft = 0.5 * (spin[2] + spin[3]) * ratio
        _, shaft_torque, shaft_inertia = clutch(p, shaft, command[1])
        torque = 0.5 * shaft_torque * ratio * p.driveline_efficiency
        inertia = 0.5 * shaft_inertia * ratio * ratio
    # An open differential gives both rear wheels equal torque, and the engine's inertia acts on
    # their mean speed. The viscous coupling reduces the difference of their speeds.
    mean_gain = 0.5 * (slip_gain[2] + slip_gain[3])
    moment_left = slip_gain[2] * (along[2] - r * spin[2])
    moment_right = slip_gain[3] * (along[3] - r * spin[3])
    road_moment = 0.5 * r * (moment_left + moment_right)
    mean_inertia = p.wheel_inertia + inertia + DT * r * r * mean_gain
    mean = 0.5 * (spin[2] + spin[3]) + DT * (torque + road_moment) / mean_inertia
    mean = limit_shaft_speed(p, mean, ratio)
    moment_difference = r * (moment_left - moment_right)
    difference_inertia = p.wheel_inertia + DT * (r * r * mean_gain + 2.0 * p.differential_viscosity)
    half = 0.5 * (spin[2] - spin[3])
    viscous = 4.0 * p.differential_viscosity * half
    half += 0.5 * DT * (moment_difference - viscous) / difference_inertia
    spin[2] = apply_brake(mean + half, rear_brake, mean_inertia, DT)
    spin[3] = apply_brake(mean - half, rear_brake, mean_inertia, DT)
    if ratio != 0.0:
        memory[ENGINE], _, _ = clutch(p, 0.5 * (spin[2] + spin[3]) * ratio, command[1])


@inlined
def add_aerodynamics(p: Any, axes: FloatArray, velocity: FloatArray, wrench: FloatArray) -> None:
    """Add the drag and the downforce of both axles to `wrench` (6,). They are quadratic in the
    forward speed. `axes` (3, 3) has the body axes as rows; `velocity` (6,) is linear, then
    angular."""
    speed = axes[0, 0] * velocity[0] + axes[0, 1] * velocity[1] + axes[0, 2] * velocity[2]
    pressure = 0.5 * p.air_density * speed * speed
    drag = pressure * (p.drag_coefficient * p.frontal_area + p.wing_drag)
    if speed < 0.0:
        drag = -drag
    front, rear = pressure * p.lift_front, pressure * p.lift_rear
    # Pitch torque of the downforce at the axles, about the body's left axis.
    turn = p.front_axle * front - p.rear_axle * rear
    for i in range(3):
        wrench[i] -= drag * axes[0, i] + (front + rear) * axes[2, i]
        wrench[3 + i] += turn * axes[1, i]


@inlined
def add_underbody_contact(
    depth: float, normal: tuple[float, float, float], velocity: FloatArray, wrench: FloatArray
) -> None:
    """Add to `wrench` the contact force of an underbody that is `depth` m below the road with the
    unit normal `normal`. The force supports a car that lies on its underbody, side or roof, where
    the wheels give no support. `velocity` (6,) is the body's velocity, linear, then angular."""
    if depth > 0.0:
        nx, ny, nz = normal
        closing = -(velocity[0] * nx + velocity[1] * ny + velocity[2] * nz)
        push = max(UNDERBODY_SPRING * depth + UNDERBODY_DAMPER * closing, 0.0)
        wrench[0] += push * nx
        wrench[1] += push * ny
        wrench[2] += push * nz


@inlined
def accelerate(
    p: Any, axes: FloatArray, wrench: FloatArray, dt: float, velocity: FloatArray
) -> None:
    """Add the change of velocity over `dt` s to `velocity` (6,), without gyroscopic terms.

    `wrench` (6,) is the force (N) and the torque (N m), `velocity` the velocity (m/s) and the
    angular velocity (rad/s), all in the world frame. `axes` (3, 3) has the body axes as rows, and
    `p` the car's parameters, with the moments of inertia about these axes.
    """
    for i in range(3):
        velocity[i] += dt * wrench[i] / p.total_mass
    for i in range(3):
        about = axes[i, 0] * wrench[3] + axes[i, 1] * wrench[4] + axes[i, 2] * wrench[5]
        gain = dt * about / p.inertia[i]
        for j in range(3):
            velocity[3 + j] += gain * axes[i, j]


@compiled
def compute_forces(
    params: NDArray[Any],
    table: Table,
    ground: Ground,
    motion: FloatArray,
    memory: FloatArray,
    command: FloatArray,
    wrench: FloatArray,
) -> None:
    """Compute the forces of one 200 Hz step. Updates `memory` (8,) and fills `wrench`, which
    includes gravity, at the centre of gravity.

    The forces are computed with the velocity half a step ahead (midpoint rule). Tyres are stiff for
    200 Hz: with the current velocity, yaw would settle as if the car had 15 % less inertia. params:
    `CarParameters.packed()`; motion (13,): see MOTION; command (4,): steer, throttle, brake, gear.
    """
    work = make_work()
    fill_axes(motion[3:7], work[0])
    at = locate(table, motion[0], motion[1], int(memory[PIECE]))
    compute_forces_at(params[0], table, ground, at, motion, memory, command, work)
    for i in range(6):
        wrench[i] = work[5][i]


@inlined
def compute_forces_at(
    p: Any,
    table: Table,
    ground: Ground,
    at: tuple[int, float, float],
    motion: FloatArray,
    memory: FloatArray,
    command: FloatArray,
    work: Work,
) -> None:
    """Compute the forces of one 200 Hz step: updates `memory` (8,) and fills the wrench in `work`.
    The body axes in `work` and the track coordinates `at` (piece index, s, to_middle) of the car
    must be computed before; see `compute_forces` for the other arguments."""
    axes, wheels, slip_gain, velocity, turned, wrench = work
    spin = memory[SPIN : SPIN + 4]
    piece, s, d = at
    memory[PIECE] = piece
    z, nx, ny, nz = surface(table, piece, s, d)
    depth = UNDERBODY_CLEARANCE_M - (motion[2] - z) * nz
    before = memory[STEER]
    memory[STEER] = move_steering(p, before, command[0], DT)
    turn_wheels(p, 0.5 * (before + memory[STEER]), turned)
    locate_contacts(p, table, ground, piece, motion, axes, turned, wheels)
    for i in range(6):
        velocity[i] = motion[7 + i]
    for stage in range(2):
        update_loads(p, velocity, wheels)
        tyre_slip_gains(p, spin, wheels, slip_gain)
        if stage == 1:
            update_wheel_speeds(p, memory, command, wheels, slip_gain)
            tyre_slip_gains(p, spin, wheels, slip_gain)
        for i in range(6):
            wrench[i] = 0.0
        wrench[2] = -p.total_mass * GRAVITY
        add_tyre_forces(p, spin, wheels, slip_gain, wrench)
        add_aerodynamics(p, axes, velocity, wrench)
        add_underbody_contact(depth, (nx, ny, nz), velocity, wrench)
        if stage == 0:
            accelerate(p, axes, wrench, 0.5 * DT, velocity)
    speed = math.sqrt(motion[7] ** 2 + motion[8] ** 2 + motion[9] ** 2)
    memory[ODOMETER] += DT * speed
