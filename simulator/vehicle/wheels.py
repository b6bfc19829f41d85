"""Contact of the four wheels with the road: geometry, suspension loads and tyre forces.

World frame z up; body frame x forward, y left, z up, origin at the centre of gravity. SI units. `p`
is the record `CarParameters.packed()[0]`. `wheels` (4, 20) has a row per wheel (front left, front
right, rear left, rear right); `wrench` (6,) is force and torque on the body in the world frame.
"""

import math
from typing import Any

from runtime.jit import compiled, inlined
from simulator.arrays import FloatArray
from simulator.track.piece_table import Table, locate, surface
from simulator.vehicle.surface import Ground, surface_under_wheel
from simulator.vehicle.tyre import peak_force, tyre_slip_gain

MAX_TRAVEL_M = 0.25
"""Largest compression of a suspension strut, measured from rest."""
MIN_UPRIGHT_COSINE = 0.2
"""If the cosine of the angle between the car's up axis and the road normal is below this value, the
car lies on its side and its wheels have no contact."""

# One wheel's row of `wheels` (4, WHEEL): arm from the centre of gravity to the contact point, road
# normal, directions forward and left in the road plane (3 each); spring force (N), damper constant
# along the normal (N s/m), grip and rolling factors of the surface; speed along and across (m/s),
# load (N), largest tyre force (N).
ARM, NORMAL, FORWARD, LEFT = 0, 3, 6, 9
SPRING, DAMPER, GRIP, ROLLING, ALONG, ACROSS, LOAD, PEAK, WHEEL = 12, 13, 14, 15, 16, 17, 18, 19, 20


@compiled
def wheel_angle(p: Any, wheel: int, steer: float) -> float:
    """Return the angle (rad) of one wheel under Ackermann steering. The inner front wheel has the
    commanded angle `steer`, as in TORCS, and both front wheels roll about one centre."""
    if wheel > 1 or steer == 0.0:
        return 0.0
    inner = (wheel == 0) == (steer > 0.0)
    if inner:
        return steer
    slope = math.tan(abs(steer))
    base = p.front_axle + p.rear_axle
    track = 0.5 * (p.front_track + p.rear_track)
    outer = math.atan2(base * slope, base + track * slope)
    return outer if steer > 0.0 else -outer


@inlined
def turn_wheels(p: Any, steer: float, turned: FloatArray) -> None:
    """Fill `turned` (9,): `steer` (rad), and the cosine and sine of each wheel's angle. Cosines and
    sines are computed only if `steer` has changed since the last call."""
    if turned[0] == steer:
        return
    turned[0] = steer
    for wheel in range(4):
        angle = wheel_angle(p, wheel, steer)
        turned[1 + 2 * wheel], turned[2 + 2 * wheel] = math.cos(angle), math.sin(angle)


@inlined
def locate_contacts(
    p: Any,
    table: Table,
    ground: Ground,
    piece: int,
    motion: FloatArray,
    axes: FloatArray,
    turned: FloatArray,
    wheels: FloatArray,
) -> None:
    """Fill the entries of `wheels` that do not depend on the body's velocity: contact point,
    directions, spring force, damper constant and surface. `piece` is the index of the piece at
    which the search starts.

    motion (13,): see `dynamics.MOTION`; axes (3, 3): body axes as rows; turned (9,): see
    `turn_wheels`.
    """
    upright = True
    for wheel in range(4):
        front = wheel < 2
        x = p.front_axle if front else -p.rear_axle
        y = 0.5 * (p.front_track if front else p.rear_track) * (1.0 if wheel % 2 == 0 else -1.0)
        px = motion[0] + axes[0, 0] * x + axes[1, 0] * y
        py = motion[1] + axes[0, 1] * x + axes[1, 1] * y
        pz = motion[2] + axes[0, 2] * x + axes[1, 2] * y
        at, s, d = locate(table, px, py, piece)
        z, nx, ny, nz = surface(table, at, s, d)
        upright_cosine = max(
            axes[2, 0] * nx + axes[2, 1] * ny + axes[2, 2] * nz, MIN_UPRIGHT_COSINE
        )
        reach = (
            (pz - z) * nz / upright_cosine
        )  # distance along the strut from the height of the CG to the road
        for i in range(3):
            wheels[wheel, ARM + i] = axes[0, i] * x + axes[1, i] * y - axes[2, i] * reach
        wheels[wheel, NORMAL], wheels[wheel, NORMAL + 1] = nx, ny
        wheels[wheel, NORMAL + 2] = nz
        set_directions(wheels, wheel, axes, turned[1 + 2 * wheel], turned[2 + 2 * wheel])
        wheels[wheel, SPRING] = min(p.cg_height - reach, MAX_TRAVEL_M)  # compression from rest
        wheels[wheel, DAMPER] = (p.damper_front if front else p.damper_rear) / upright_cosine
        upright = upright and upright_cosine > MIN_UPRIGHT_COSINE
        wheels[wheel, GRIP], wheels[wheel, ROLLING] = surface_under_wheel(ground, d)
    for axle in range(2):
        a, b = wheels[2 * axle, SPRING], wheels[2 * axle + 1, SPRING]
        wheels[2 * axle, SPRING] = spring_force(p, axle == 0, a, b)
        wheels[2 * axle + 1, SPRING] = spring_force(p, axle == 0, b, a)
    if not upright:
        for wheel in range(4):
            wheels[wheel, SPRING], wheels[wheel, DAMPER] = 0.0, 0.0


@inlined
def set_directions(
    wheels: FloatArray, wheel: int, axes: FloatArray, cos_a: float, sin_a: float
) -> None:
    """Fill the unit vectors forward and left of a wheel's row, both in the road plane. The wheel is
    turned to the left of the body's forward axis by the angle with the cosine `cos_a` and the sine
    `sin_a`."""
    nx, ny, nz = wheels[wheel, NORMAL], wheels[wheel, NORMAL + 1], wheels[wheel, NORMAL + 2]
    fx = axes[0, 0] * cos_a + axes[1, 0] * sin_a
    fy = axes[0, 1] * cos_a + axes[1, 1] * sin_a
    fz = axes[0, 2] * cos_a + axes[1, 2] * sin_a
    above = fx * nx + fy * ny + fz * nz
    fx, fy, fz = fx - above * nx, fy - above * ny, fz - above * nz
    length = math.sqrt(fx * fx + fy * fy + fz * fz)
    fx, fy, fz = fx / length, fy / length, fz / length
    wheels[wheel, FORWARD], wheels[wheel, FORWARD + 1] = fx, fy
    wheels[wheel, FORWARD + 2] = fz
    wheels[wheel, LEFT] = ny * fz - nz * fy
    wheels[wheel, LEFT + 1] = nz * fx - nx * fz
    wheels[wheel, LEFT + 2] = nx * fy - ny * fx


@inlined
def spring_force(p: Any, front: bool, compression: float, other: float) -> float:
    """Return the force (N) of the spring, anti-roll bar and bump stop of a front (`front`) or rear
    wheel at `compression` m from rest; `other` (m) is the compression of the axle's other wheel."""
    force = p.load_front if front else p.load_rear
    force += (p.spring_front if front else p.spring_rear) * compression
    force += (p.anti_roll_front if front else p.anti_roll_rear) * (compression - other)
    return float(force + p.bump_spring * max(compression - p.bump_travel, 0.0))


@inlined
def along(wheels: FloatArray, wheel: int, axis: int, vx: float, vy: float, vz: float) -> float:
    """Return the component of the velocity (vx, vy, vz) along one of a wheel's unit vectors; `axis`
    is the vector's first column in `wheels` (FORWARD, LEFT or NORMAL)."""
    x, y, z = wheels[wheel, axis], wheels[wheel, axis + 1], wheels[wheel, axis + 2]
    return float(vx * x + vy * y + vz * z)


@inlined
def update_loads(p: Any, velocity: FloatArray, wheels: FloatArray) -> None:
    """Fill the entries of `wheels` that depend on the body's `velocity` (6,), linear and angular:
    speeds of the contact point (m/s), load (N), largest tyre force (N)."""
    for wheel in range(4):
        x, y, z = wheels[wheel, ARM], wheels[wheel, ARM + 1], wheels[wheel, ARM + 2]
        vx = velocity[0] + velocity[4] * z - velocity[5] * y
        vy = velocity[1] + velocity[5] * x - velocity[3] * z
        vz = velocity[2] + velocity[3] * y - velocity[4] * x
        wheels[wheel, ALONG] = along(wheels, wheel, FORWARD, vx, vy, vz)
        wheels[wheel, ACROSS] = along(wheels, wheel, LEFT, vx, vy, vz)
        closing = -along(wheels, wheel, NORMAL, vx, vy, vz)
        load = max(wheels[wheel, SPRING] + wheels[wheel, DAMPER] * closing, 0.0)
        wheels[wheel, LOAD] = load
        wheels[wheel, PEAK] = peak_force(p, wheel < 2, load, wheels[wheel, GRIP])


@inlined
def tyre_slip_gains(p: Any, spin: FloatArray, wheels: FloatArray, slip_gain: FloatArray) -> None:
    """Fill `slip_gain` (4,): tyre force per m/s of slip speed (N s/m). `spin` (4,) are the wheel
    speeds (rad/s), `wheels` (4, 20) the rows of the wheels."""
    for wheel in range(4):
        slip_gain[wheel] = tyre_slip_gain(
            p,
            wheels[wheel, PEAK],
            wheels[wheel, ALONG],
            wheels[wheel, ACROSS],
            spin[wheel],
        )


@inlined
def add_tyre_forces(
    p: Any, spin: FloatArray, wheels: FloatArray, slip_gain: FloatArray, wrench: FloatArray
) -> None:
    """Add the forces and torques of the road on the four wheels to `wrench`. spin (4,): wheel
    speeds (rad/s); slip_gain (4,): tyre force per m/s of slip speed (N s/m)."""
    for wheel in range(4):
        speed, load = wheels[wheel, ALONG], wheels[wheel, LOAD]
        resistance = p.rolling_resistance * wheels[wheel, ROLLING] * load
        rolling = resistance * min(max(speed / 0.5, -1.0), 1.0)
        forward = slip_gain[wheel] * (spin[wheel] * p.wheel_radius - speed) - rolling
        leftward = -slip_gain[wheel] * wheels[wheel, ACROSS]
        add_force(
            wrench,
            component(wheels, wheel, 0, forward, leftward, load),
            component(wheels, wheel, 1, forward, leftward, load),
            component(wheels, wheel, 2, forward, leftward, load),
            wheels[wheel, ARM],
            wheels[wheel, ARM + 1],
            wheels[wheel, ARM + 2],
        )


@inlined
def component(
    wheels: FloatArray, wheel: int, axis: int, forward: float, leftward: float, load: float
) -> float:
    """Return the component along world axis `axis` (0 to 2) of the force on wheel `wheel`, a row of
    `wheels`. The force is given by its parts (N) along the wheel's directions (`forward`,
    `leftward`) and along the road normal (`load`)."""
    ahead = wheels[wheel, FORWARD + axis] * forward
    return float(
        ahead + wheels[wheel, LEFT + axis] * leftward + wheels[wheel, NORMAL + axis] * load
    )


@inlined
def add_force(
    wrench: FloatArray,
    fx: float,
    fy: float,
    fz: float,
    arm_x: float,
    arm_y: float,
    arm_z: float,
) -> None:
    """Add a force (fx, fy, fz) (N, world frame) to `wrench` (6,). Its arm (arm_x, arm_y, arm_z) (m)
    reaches from the centre of gravity to the point where the force acts."""
    wrench[0] += fx
    wrench[1] += fy
    wrench[2] += fz
    wrench[3] += arm_y * fz - arm_z * fy
    wrench[4] += arm_z * fx - arm_x * fz
    wrench[5] += arm_x * fy - arm_y * fx
