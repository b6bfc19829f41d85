"""Forces of the four wheels and of the air on the car's body, at 200 Hz, in one compiled step.

World frame z up; body frame x forward, y left, z up, origin at the centre of gravity. SI units.
PyBullet moves the body; this file only says which force and torque act on it.
"""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from simulator.car import GRAVITY
from simulator.compiled import compiled
from simulator.engine import clutch, free_engine_speed, gear_ratio
from simulator.track.kernel import Table, locate, surface
from simulator.tyre import SLOWEST_M_S, slip_force_ratio

Vector = NDArray[np.float64]

PHYSICS_HZ = 200
DT = 1.0 / PHYSICS_HZ

# What the car remembers between steps beside its body's motion: `memory`, shape (MEMORY,).
STEER, ENGINE, SPIN, PIECE, ODOMETER, MEMORY = 0, 1, 2, 6, 7, 8
# One motion: position, quaternion (x, y, z, w), velocity, angular velocity, all in the world.
MOTION = 13

BELLY_CLEARANCE = 0.10
"""m of the centre of gravity over the road at which the underbody touches it."""
BELLY_SPRING, BELLY_DAMPER = 500_000.0, 20_000.0


@compiled
def dot(a: Vector, b: Vector) -> float:
    """Scalar product of two 3-vectors, summed in a fixed order."""
    return float(a[0] * b[0] + a[1] * b[1] + a[2] * b[2])


@compiled
def rotation(quaternion: Vector) -> Vector:
    """Body axes (forward, left, up) as the rows of a (3, 3) matrix, from a unit quaternion
    (x, y, z, w)."""
    x, y, z, w = quaternion
    axes = np.empty((3, 3))
    axes[0, 0] = 1.0 - 2.0 * (y * y + z * z)
    axes[0, 1] = 2.0 * (x * y + w * z)
    axes[0, 2] = 2.0 * (x * z - w * y)
    axes[1, 0] = 2.0 * (x * y - w * z)
    axes[1, 1] = 1.0 - 2.0 * (x * x + z * z)
    axes[1, 2] = 2.0 * (y * z + w * x)
    axes[2, 0] = 2.0 * (x * z + w * y)
    axes[2, 1] = 2.0 * (y * z - w * x)
    axes[2, 2] = 1.0 - 2.0 * (x * x + y * y)
    return axes


@compiled
def move_steering(p: Any, angle: float, command: float, dt: float) -> float:
    """Front wheel angle (rad) after `dt` of turning towards `command` in [-1, 1]."""
    step = p.steering_rate * dt
    wanted = command * p.steering_lock
    return float(angle + min(max(wanted - angle, -step), step))


@compiled
def add_force(wrench: Vector, force: Vector, arm: Vector) -> None:
    """Add a world-frame force at `arm` from the centre of gravity to (force, torque)."""
    for i in range(3):
        wrench[i] += force[i]
    wrench[3] += arm[1] * force[2] - arm[2] * force[1]
    wrench[4] += arm[2] * force[0] - arm[0] * force[2]
    wrench[5] += arm[0] * force[1] - arm[1] * force[0]


@compiled
def point_velocity(motion: Vector, arm: Vector) -> Vector:
    """World velocity of the body's point at `arm` from the centre of gravity."""
    velocity = np.empty(3)
    velocity[0] = motion[7] + motion[11] * arm[2] - motion[12] * arm[1]
    velocity[1] = motion[8] + motion[12] * arm[0] - motion[10] * arm[2]
    velocity[2] = motion[9] + motion[10] * arm[1] - motion[11] * arm[0]
    return velocity


@compiled
def suspend(
    p: Any, table: Table, piece: int, motion: Vector, axes: Vector, contacts: Vector
) -> None:
    """Where each wheel meets the road and how hard it presses.

    Fills `contacts` (4, 12): arm to the contact point, road normal, velocity of the contact point,
    load (N), compression from rest (m), damper force (N).
    """
    up = axes[2]
    for wheel in range(4):
        front, left = wheel < 2, wheel % 2 == 0
        x = p.front_axle if front else -p.rear_axle
        y = 0.5 * (p.front_track if front else p.rear_track) * (1.0 if left else -1.0)
        hub = axes[0] * x + axes[1] * y
        px, py, pz = motion[0] + hub[0], motion[1] + hub[1], motion[2] + hub[2]
        at, s, d = locate(table, px, py, piece)
        z, nx, ny, nz = surface(table, at, s, d)
        lean = max(up[0] * nx + up[1] * ny + up[2] * nz, 0.2)
        reach = (pz - z) * nz / lean  # along the strut, from the height of the CG to the road
        arm = hub - up * reach
        velocity = point_velocity(motion, arm)
        closing = -(velocity[0] * nx + velocity[1] * ny + velocity[2] * nz) / lean
        contacts[wheel, 0:3] = arm
        contacts[wheel, 3], contacts[wheel, 4], contacts[wheel, 5] = nx, ny, nz
        contacts[wheel, 6:9] = velocity
        contacts[wheel, 10] = p.cg_height - reach
        contacts[wheel, 11] = (p.damper_front if front else p.damper_rear) * closing
    for wheel in range(4):
        front = wheel < 2
        squeeze = contacts[wheel, 10]
        other = contacts[wheel + 1 if wheel % 2 == 0 else wheel - 1, 10]
        load = p.load_front if front else p.load_rear
        load += (p.spring_front if front else p.spring_rear) * squeeze
        load += (p.anti_roll_front if front else p.anti_roll_rear) * (squeeze - other)
        load += p.bump_spring * max(squeeze - p.bump_travel, 0.0) + contacts[wheel, 11]
        contacts[wheel, 9] = max(load, 0.0)


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
def spin_wheels(p: Any, memory: Vector, command: Vector, along: Vector, grip: Vector) -> None:
    """Advance the four wheel speeds in `memory` over one step, implicitly in the tyre force.

    `along` (4,): ground speed along each wheel (m/s); `grip` (4,): tyre force (N) for each m/s by
    which the tread runs faster than the ground. command: steer, throttle, brake, gear.
    """
    r, gear = p.wheel_radius, int(command[3])
    ratio = gear_ratio(p, gear)
    brake = p.brake_torque * command[2]
    spin = memory[SPIN : SPIN + 4]
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
def tread(p: Any, memory: Vector, axes: Vector, contacts: Vector, treads: Vector) -> None:
    """Fill `treads` (4, 8): the wheel's forward and left direction in the road plane, ground speed
    along and across the wheel (m/s)."""
    cos_steer, sin_steer = math.cos(memory[STEER]), math.sin(memory[STEER])
    for wheel in range(4):
        ahead = axes[0]
        if wheel < 2:
            ahead = axes[0] * cos_steer + axes[1] * sin_steer
        normal = contacts[wheel, 3:6]
        forward = ahead - normal * dot(ahead, normal)
        forward = forward / math.sqrt(dot(forward, forward))
        treads[wheel, 0:3] = forward
        treads[wheel, 3] = normal[1] * forward[2] - normal[2] * forward[1]
        treads[wheel, 4] = normal[2] * forward[0] - normal[0] * forward[2]
        treads[wheel, 5] = normal[0] * forward[1] - normal[1] * forward[0]
        treads[wheel, 6] = dot(contacts[wheel, 6:9], forward)
        treads[wheel, 7] = dot(contacts[wheel, 6:9], treads[wheel, 3:6])


@compiled
def tyre_grip(p: Any, wheel: int, load: float, along: float, across: float, spin: float) -> float:
    """Tyre force (N) for each m/s of slip speed, at the present combined slip."""
    reference = max(abs(along), SLOWEST_M_S)
    slip = math.hypot((spin * p.wheel_radius - along), across) / reference
    static = p.load_front if wheel < 2 else p.load_rear
    stiffness = p.cornering_stiffness * load / static
    return slip_force_ratio(slip, load, stiffness, p.friction, p.tyre_shape) / reference


@compiled
def add_air(p: Any, motion: Vector, axes: Vector, wrench: Vector) -> None:
    """Drag along the body, downforce at both axles (quadratic in the forward speed)."""
    forward = axes[0]
    speed = forward[0] * motion[7] + forward[1] * motion[8] + forward[2] * motion[9]
    pressure = 0.5 * p.air_density * speed * abs(speed)
    area = p.drag_coefficient * p.frontal_area + p.wing_drag
    add_force(wrench, -pressure * area * forward, 0.0 * forward)
    press = 0.5 * p.air_density * speed * speed
    add_force(wrench, -press * p.lift_front * axes[2], p.front_axle * forward)
    add_force(wrench, -press * p.lift_rear * axes[2], -p.rear_axle * forward)


@compiled
def add_belly(table: Table, piece: int, motion: Vector, wrench: Vector) -> None:
    """Hold a car that lies on its belly, side or roof above the road (the wheels then do not)."""
    at, s, d = locate(table, motion[0], motion[1], piece)
    z, nx, ny, nz = surface(table, at, s, d)
    depth = BELLY_CLEARANCE - (motion[2] - z) * nz
    if depth > 0.0:
        closing = -(motion[7] * nx + motion[8] * ny + motion[9] * nz)
        push = max(BELLY_SPRING * depth + BELLY_DAMPER * closing, 0.0)
        wrench[0] += push * nx
        wrench[1] += push * ny
        wrench[2] += push * nz


@compiled
def advance(
    params: NDArray[Any], table: Table, motion: Vector, memory: Vector, command: Vector
) -> Vector:
    """One 200 Hz step: updates `memory` and returns the (force, torque) (6,) on the body, at its
    centre of gravity, in the world frame, gravity included.

    params: `CarParameters.packed()`; command: steer, throttle, brake in their ranges, and gear.
    """
    p = params[0]
    wrench = np.zeros(6)
    contacts = np.empty((4, 12))
    treads = np.empty((4, 8))
    along, grip = np.empty(4), np.empty(4)
    axes = rotation(motion[3:7])
    piece, _, _ = locate(table, motion[0], motion[1], int(memory[PIECE]))
    memory[PIECE] = piece
    memory[STEER] = move_steering(p, memory[STEER], command[0], DT)
    suspend(p, table, piece, motion, axes, contacts)
    tread(p, memory, axes, contacts, treads)
    for wheel in range(4):
        along[wheel] = treads[wheel, 6]
        spin = memory[SPIN + wheel]
        grip[wheel] = tyre_grip(p, wheel, contacts[wheel, 9], along[wheel], treads[wheel, 7], spin)
    spin_wheels(p, memory, command, along, grip)
    for wheel in range(4):
        load, across = contacts[wheel, 9], treads[wheel, 7]
        spin = memory[SPIN + wheel]
        ratio = tyre_grip(p, wheel, load, along[wheel], across, spin)
        rolling = p.rolling_resistance * load * min(max(along[wheel] / 0.5, -1.0), 1.0)
        forward = ratio * (spin * p.wheel_radius - along[wheel]) - rolling
        force = treads[wheel, 0:3] * forward - treads[wheel, 3:6] * (ratio * across)
        add_force(wrench, force + contacts[wheel, 3:6] * load, contacts[wheel, 0:3])
    add_air(p, motion, axes, wrench)
    add_belly(table, piece, motion, wrench)
    wrench[2] -= p.total_mass * GRAVITY
    memory[ODOMETER] += DT * math.sqrt(motion[7] ** 2 + motion[8] ** 2 + motion[9] ** 2)
    return wrench
