"""Contact of the four wheels with the road: geometry, suspension loads and tyre forces.

World frame z up; body frame x forward, y left, z up, origin at the centre of gravity. SI units.
"""

import math
from typing import Any

from runtime.jit import compiled
from simulator.arrays import FloatArray
from simulator.track.piece_table import Table, locate, surface
from simulator.vehicle.surface import Ground, surface_under_wheel
from simulator.vehicle.tyre import peak_force, tyre_slip_gain

MAX_TRAVEL_M = 0.25
"""Largest compression of a suspension strut from rest."""
MIN_UPRIGHT_COSINE = 0.2
"""Cosine of the angle between the car's up axis and the road normal below which the car lies on its
side, without wheel contact."""

# One wheel's row of `wheels` (4, WHEEL): arm from the centre of gravity to the contact point, road
# normal, directions forward and left in the road plane (3 each); spring force (N), damper constant
# along the normal (N s/m), grip and rolling factors of the surface; speed along and across (m/s),
# load (N), largest tyre force (N).
ARM, NORMAL, FORWARD, LEFT = 0, 3, 6, 9
SPRING, DAMPER, GRIP, ROLLING, ALONG, ACROSS, LOAD, PEAK, WHEEL = 12, 13, 14, 15, 16, 17, 18, 19, 20


@compiled
def wheel_angle(p: Any, wheel: int, steer: float) -> float:
    """Angle (rad) of one wheel under Ackermann steering: the inner front wheel has the commanded
    angle `steer`, as in TORCS, and both front wheels roll about one centre."""
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


@compiled
def turn_wheels(p: Any, steer: float, turned: FloatArray) -> None:
    """Fill `turned` (9,): `steer`, and the cosine and sine of each wheel's angle. Steering mostly
    rests, so that they are computed once for several steps."""
    if turned[0] == steer:
        return
    turned[0] = steer
    for wheel in range(4):
        angle = wheel_angle(p, wheel, steer)
        turned[1 + 2 * wheel], turned[2 + 2 * wheel] = math.cos(angle), math.sin(angle)


@compiled
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
    directions, spring force, damper constant and surface.

    axes (3, 3): body axes as rows; turned (9,): see `turn_wheels`.
    """
    ahead, left, up = axes[0], axes[1], axes[2]
    upright = True
    for wheel in range(4):
        row = wheels[wheel]
        front = wheel < 2
        x = p.front_axle if front else -p.rear_axle
        y = 0.5 * (p.front_track if front else p.rear_track) * (1.0 if wheel % 2 == 0 else -1.0)
        px = motion[0] + ahead[0] * x + left[0] * y
        py = motion[1] + ahead[1] * x + left[1] * y
        pz = motion[2] + ahead[2] * x + left[2] * y
        at, s, d = locate(table, px, py, piece)
        z, nx, ny, nz = surface(table, at, s, d)
        upright_cosine = max(up[0] * nx + up[1] * ny + up[2] * nz, MIN_UPRIGHT_COSINE)
        reach = (
            (pz - z) * nz / upright_cosine
        )  # along the strut, from the height of the CG to the road
        for i in range(3):
            row[ARM + i] = ahead[i] * x + left[i] * y - up[i] * reach
        row[NORMAL], row[NORMAL + 1], row[NORMAL + 2] = nx, ny, nz
        set_directions(row, axes, turned[1 + 2 * wheel], turned[2 + 2 * wheel])
        row[SPRING] = min(p.cg_height - reach, MAX_TRAVEL_M)  # compression from rest
        row[DAMPER] = (p.damper_front if front else p.damper_rear) / upright_cosine
        upright = upright and upright_cosine > MIN_UPRIGHT_COSINE
        row[GRIP], row[ROLLING] = surface_under_wheel(ground, d)
    for axle in range(2):
        a, b = wheels[2 * axle, SPRING], wheels[2 * axle + 1, SPRING]
        wheels[2 * axle, SPRING] = spring_force(p, axle == 0, a, b)
        wheels[2 * axle + 1, SPRING] = spring_force(p, axle == 0, b, a)
    if not upright:
        for wheel in range(4):
            wheels[wheel, SPRING], wheels[wheel, DAMPER] = 0.0, 0.0


@compiled
def set_directions(row: FloatArray, axes: FloatArray, cos_a: float, sin_a: float) -> None:
    """Fill in a wheel's directions in the road plane, turned to the left of the body's by the angle
    of this cosine and sine."""
    nx, ny, nz = row[NORMAL], row[NORMAL + 1], row[NORMAL + 2]
    fx = axes[0, 0] * cos_a + axes[1, 0] * sin_a
    fy = axes[0, 1] * cos_a + axes[1, 1] * sin_a
    fz = axes[0, 2] * cos_a + axes[1, 2] * sin_a
    above = fx * nx + fy * ny + fz * nz
    fx, fy, fz = fx - above * nx, fy - above * ny, fz - above * nz
    length = math.sqrt(fx * fx + fy * fy + fz * fz)
    fx, fy, fz = fx / length, fy / length, fz / length
    row[FORWARD], row[FORWARD + 1], row[FORWARD + 2] = fx, fy, fz
    row[LEFT] = ny * fz - nz * fy
    row[LEFT + 1] = nz * fx - nx * fz
    row[LEFT + 2] = nx * fy - ny * fx


@compiled
def spring_force(p: Any, front: bool, compression: float, other: float) -> float:
    """Force (N) of one wheel's spring, anti-roll bar and bump stop, at `compression` m from rest,
    the other wheel of the axle at `other` m."""
    force = p.load_front if front else p.load_rear
    force += (p.spring_front if front else p.spring_rear) * compression
    force += (p.anti_roll_front if front else p.anti_roll_rear) * (compression - other)
    return float(force + p.bump_spring * max(compression - p.bump_travel, 0.0))


@compiled
def update_loads(p: Any, velocity: FloatArray, wheels: FloatArray) -> None:
    """Fill the entries of `wheels` that depend on the body's `velocity` (6,), linear and angular:
    contact point speeds, load, largest tyre force."""
    for wheel in range(4):
        row = wheels[wheel]
        x, y, z = row[ARM], row[ARM + 1], row[ARM + 2]
        vx = velocity[0] + velocity[4] * z - velocity[5] * y
        vy = velocity[1] + velocity[5] * x - velocity[3] * z
        vz = velocity[2] + velocity[3] * y - velocity[4] * x
        row[ALONG] = vx * row[FORWARD] + vy * row[FORWARD + 1] + vz * row[FORWARD + 2]
        row[ACROSS] = vx * row[LEFT] + vy * row[LEFT + 1] + vz * row[LEFT + 2]
        closing = -(vx * row[NORMAL] + vy * row[NORMAL + 1] + vz * row[NORMAL + 2])
        row[LOAD] = max(row[SPRING] + row[DAMPER] * closing, 0.0)
        row[PEAK] = peak_force(p, wheel < 2, row[LOAD], row[GRIP])


@compiled
def tyre_slip_gains(p: Any, spin: FloatArray, wheels: FloatArray, slip_gain: FloatArray) -> None:
    """Fill `slip_gain` (4,): tyre force per m/s of slip speed (N s/m); `spin` (4,) rad/s."""
    for wheel in range(4):
        row = wheels[wheel]
        slip_gain[wheel] = tyre_slip_gain(p, row[PEAK], row[ALONG], row[ACROSS], spin[wheel])


@compiled
def add_tyre_forces(
    p: Any, spin: FloatArray, wheels: FloatArray, slip_gain: FloatArray, wrench: FloatArray
) -> None:
    """Add the forces and torques of the road on the four wheels to `wrench` (6,)."""
    for wheel in range(4):
        row = wheels[wheel]
        along, load = row[ALONG], row[LOAD]
        rolling = p.rolling_resistance * row[ROLLING] * load * min(max(along / 0.5, -1.0), 1.0)
        forward = slip_gain[wheel] * (spin[wheel] * p.wheel_radius - along) - rolling
        leftward = -slip_gain[wheel] * row[ACROSS]
        add_force(
            wrench,
            row[FORWARD] * forward + row[LEFT] * leftward + row[NORMAL] * load,
            row[FORWARD + 1] * forward + row[LEFT + 1] * leftward + row[NORMAL + 1] * load,
            row[FORWARD + 2] * forward + row[LEFT + 2] * leftward + row[NORMAL + 2] * load,
            row[ARM : ARM + 3],
        )


@compiled
def add_force(wrench: FloatArray, fx: float, fy: float, fz: float, arm: FloatArray) -> None:
    """Add a world-frame force at `arm` (3,) from the centre of gravity to `wrench` (6,)."""
    wrench[0] += fx
    wrench[1] += fy
    wrench[2] += fz
    wrench[3] += arm[1] * fz - arm[2] * fy
    wrench[4] += arm[2] * fx - arm[0] * fz
    wrench[5] += arm[0] * fy - arm[1] * fx
