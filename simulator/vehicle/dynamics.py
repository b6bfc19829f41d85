"""Forces of the four wheels and of the air on the car's body, at 200 Hz, in one compiled step.

World frame z up; body frame x forward, y left, z up, origin at the centre of gravity. SI units.
This file only says which force and torque act on the body; `flight` and PyBullet move it.
"""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from runtime.jit import compiled
from simulator.track.kernel import Table, locate, surface
from simulator.vehicle.car import GRAVITY
from simulator.vehicle.orientation import rotation
from simulator.vehicle.powertrain import clutch, free_engine_speed, gear_ratio
from simulator.vehicle.surface import Ground
from simulator.vehicle.wheels import ALONG, WHEEL, add_tyres, feel, stand, tyre_grips
from simulator.world.physics import PHYSICS_HZ

Vector = NDArray[np.float64]

DT = 1.0 / PHYSICS_HZ

# What the car remembers between steps beside its body's motion: `memory`, shape (MEMORY,).
STEER, ENGINE, SPIN, PIECE, ODOMETER, MEMORY = 0, 1, 2, 6, 7, 8
# One motion: position, quaternion (x, y, z, w), velocity, angular velocity, all in the world.
MOTION = 13
BELLY_CLEARANCE = 0.10
"""m of the centre of gravity over the road at which the underbody touches it."""
BELLY_SPRING, BELLY_DAMPER = 500_000.0, 20_000.0


@compiled
def move_steering(p: Any, angle: float, command: float, dt: float) -> float:
    """Front wheel angle (rad) after `dt` of turning towards `command` in [-1, 1]."""
    step = p.steering_rate * dt
    wanted = command * p.steering_lock
    return float(angle + min(max(wanted - angle, -step), step))


@compiled
def braked(spin: float, brake: float, inertia: float, dt: float) -> float:
    """`spin` (rad/s) after a friction torque `brake` (N m) has acted for `dt`; it never reverses
    the wheel."""
    lost = brake * dt / inertia
    if spin > lost:
        return spin - lost
    if spin < -lost:
        return spin + lost
    return 0.0


@compiled
def spin_wheels(p: Any, memory: Vector, command: Vector, wheels: Vector, grip: Vector) -> None:
    """Advance the four wheel speeds in `memory` over one step, implicitly in the tyre force.

    `grip` (4,): tyre force (N) for each m/s by which the tread runs faster than the ground.
    command: steer, throttle, brake, gear.
    """
    r, gear = p.wheel_radius, int(command[3])
    ratio = gear_ratio(p, gear)
    brake = p.brake_torque * command[2]
    spin, along = memory[SPIN : SPIN + 4], wheels[:, ALONG]
    front_brake = 0.5 * brake * p.brake_front_share
    rear_brake = 0.5 * brake * (1.0 - p.brake_front_share)
    for wheel in range(2):
        drag = p.wheel_inertia + DT * r * r * grip[wheel]
        free = (p.wheel_inertia * spin[wheel] + DT * r * grip[wheel] * along[wheel]) / drag
        spin[wheel] = braked(free, front_brake, drag, DT)
    torque, inertia = 0.0, 0.0
    if ratio == 0.0:
        memory[ENGINE] = free_engine_speed(p, memory[ENGINE], command[1], DT)
    else:
        shaft = 0.5 * (spin[2] + spin[3]) * ratio
        _, shaft_torque, shaft_inertia = clutch(p, shaft, command[1])
        torque = 0.5 * shaft_torque * ratio * p.driveline_efficiency
        inertia = 0.5 * shaft_inertia * ratio * ratio
    # An open differential gives both wheels the same torque; the engine's inertia turns with
    # their mean. The viscous coupling brings their speeds together.
    mean_grip = 0.5 * (grip[2] + grip[3])
    pull = 0.5 * r * (grip[2] * (along[2] - r * spin[2]) + grip[3] * (along[3] - r * spin[3]))
    heavy = p.wheel_inertia + inertia + DT * r * r * mean_grip
    mean = 0.5 * (spin[2] + spin[3]) + DT * (torque + pull) / heavy
    apart = r * (grip[2] * (along[2] - r * spin[2]) - grip[3] * (along[3] - r * spin[3]))
    light = p.wheel_inertia + DT * (r * r * mean_grip + 2.0 * p.differential_viscosity)
    half = 0.5 * (spin[2] - spin[3])
    half += 0.5 * DT * (apart - 4.0 * p.differential_viscosity * half) / light
    spin[2] = braked(mean + half, rear_brake, heavy, DT)
    spin[3] = braked(mean - half, rear_brake, heavy, DT)
    if ratio != 0.0:
        memory[ENGINE], _, _ = clutch(p, 0.5 * (spin[2] + spin[3]) * ratio, command[1])


@compiled
def add_air(p: Any, axes: Vector, velocity: Vector, wrench: Vector) -> None:
    """Drag along the body, downforce at both axles (quadratic in the forward speed)."""
    ahead, up = axes[0], axes[2]
    speed = ahead[0] * velocity[0] + ahead[1] * velocity[1] + ahead[2] * velocity[2]
    pressure = 0.5 * p.air_density * speed * speed
    drag = pressure * (p.drag_coefficient * p.frontal_area + p.wing_drag)
    if speed < 0.0:
        drag = -drag
    front, rear = pressure * p.lift_front, pressure * p.lift_rear
    # The downforce at the axles turns the body about its left axis.
    turn = p.front_axle * front - p.rear_axle * rear
    for i in range(3):
        wrench[i] -= drag * ahead[i] + (front + rear) * up[i]
        wrench[3 + i] += turn * axes[1, i]


@compiled
def add_belly(
    depth: float, normal: tuple[float, float, float], velocity: Vector, wrench: Vector
) -> None:
    """Hold a car that lies on its belly, side or roof above the road (the wheels then do not)."""
    if depth > 0.0:
        nx, ny, nz = normal
        closing = -(velocity[0] * nx + velocity[1] * ny + velocity[2] * nz)
        push = max(BELLY_SPRING * depth + BELLY_DAMPER * closing, 0.0)
        wrench[0] += push * nx
        wrench[1] += push * ny
        wrench[2] += push * nz


@compiled
def accelerate(p: Any, axes: Vector, wrench: Vector, dt: float, velocity: Vector) -> None:
    """Add to `velocity` (6,) what (force, torque) makes of it in `dt`."""
    for i in range(3):
        velocity[i] += dt * wrench[i] / p.total_mass
    for i in range(3):
        about = axes[i, 0] * wrench[3] + axes[i, 1] * wrench[4] + axes[i, 2] * wrench[5]
        gain = dt * about / p.inertia[i]
        for j in range(3):
            velocity[3 + j] += gain * axes[i, j]


@compiled
def advance(
    params: NDArray[Any],
    table: Table,
    ground: Ground,
    motion: Vector,
    memory: Vector,
    command: Vector,
    wrench: Vector,
) -> None:
    """One 200 Hz step: updates `memory` and fills `wrench` (6,), the (force, torque) on the body
    at its centre of gravity, in the world frame, gravity included.

    The forces are those at the velocity half a step ahead (the midpoint rule). With those of the
    velocity now, yaw settles as if the car had 15 % less inertia: tyres are stiff for 200 Hz.
    params: `CarParameters.packed()`; command: steer, throttle, brake in their ranges, and gear.
    """
    p = params[0]
    wheels, grip, spin = np.empty((4, WHEEL)), np.empty(4), memory[SPIN : SPIN + 4]
    axes = rotation(motion[3:7])
    piece, s, d = locate(table, motion[0], motion[1], int(memory[PIECE]))
    memory[PIECE] = piece
    z, nx, ny, nz = surface(table, piece, s, d)
    depth = BELLY_CLEARANCE - (motion[2] - z) * nz
    before = memory[STEER]
    memory[STEER] = move_steering(p, before, command[0], DT)
    stand(p, table, ground, piece, motion, axes, 0.5 * (before + memory[STEER]), wheels)
    velocity = motion[7:13].copy()
    for half in range(2):
        feel(p, velocity, wheels)
        tyre_grips(p, spin, wheels, grip)
        if half == 1:
            spin_wheels(p, memory, command, wheels, grip)
            tyre_grips(p, spin, wheels, grip)
        wrench[:] = 0.0
        wrench[2] = -p.total_mass * GRAVITY
        add_tyres(p, spin, wheels, grip, wrench)
        add_air(p, axes, velocity, wrench)
        add_belly(depth, (nx, ny, nz), velocity, wrench)
        if half == 0:
            accelerate(p, axes, wrench, 0.5 * DT, velocity)
    speed = math.sqrt(motion[7] ** 2 + motion[8] ** 2 + motion[9] ** 2)
    memory[ODOMETER] += DT * speed
