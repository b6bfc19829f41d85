"""Rigid-body motion of the ego car while no contact is possible, in one compiled call.

Integrates with PyBullet's scheme (semi-implicit Euler, exact rotation), so that the result is the
same whether PyBullet or this code moves the body. World frame, SI units.
"""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from runtime.jit import compiled
from simulator.arrays import FloatArray
from simulator.track.piece_table import Table, locate
from simulator.traffic.wreck import TRAFFIC_CAR
from simulator.vehicle.dynamics import DT, PIECE, accelerate, compute_forces
from simulator.vehicle.orientation import rotation
from simulator.vehicle.surface import Ground

WALL_RANGE_M = 3.5
"""Largest distance of any part of the car from its centre of gravity, with a margin for the motion
of one physics step."""
CAR_RANGE_M = 6.5
"""Largest distance between the centres of two cars that may touch within one physics step."""
MAX_TRAFFIC_SPEED_M_S = 20.0
CLEARANCE_M = 0.3
OTHER_LENGTH, OTHER_WIDTH = TRAFFIC_CAR.length, TRAFFIC_CAR.width


@compiled
def gyroscopic_change(p: Any, axes: FloatArray, motion: FloatArray) -> tuple[float, float, float]:
    """Change of the angular velocity (body frame, rad/s) by one step of Euler's equations without
    torque: one Newton step of the implicit rule, as in PyBullet (Catto, GDC 2015)."""
    wx = axes[0, 0] * motion[10] + axes[0, 1] * motion[11] + axes[0, 2] * motion[12]
    wy = axes[1, 0] * motion[10] + axes[1, 1] * motion[11] + axes[1, 2] * motion[12]
    wz = axes[2, 0] * motion[10] + axes[2, 1] * motion[11] + axes[2, 2] * motion[12]
    ix, iy, iz = p.inertia[0], p.inertia[1], p.inertia[2]
    # f = dt w x (I w), and its Jacobian I + dt (skew(w) I - skew(I w)).
    fx, fy, fz = DT * (iz - iy) * wy * wz, DT * (ix - iz) * wz * wx, DT * (iy - ix) * wx * wy
    yz, zy = DT * (iz - iy) * wz, DT * (iz - iy) * wy
    zx, xz = DT * (ix - iz) * wx, DT * (ix - iz) * wz
    xy, yx = DT * (iy - ix) * wy, DT * (iy - ix) * wx
    # Rows of the Jacobian: (ix, yz, zy), (xz, iy, zx), (xy, yx, iz); solved by Cramer's rule.
    determinant = ix * (iy * iz - zx * yx) - yz * (xz * iz - zx * xy) + zy * (xz * yx - iy * xy)
    gx = fx * (iy * iz - zx * yx) - yz * (fy * iz - zx * fz) + zy * (fy * yx - iy * fz)
    gy = ix * (fy * iz - zx * fz) - fx * (xz * iz - zx * xy) + zy * (xz * fz - fy * xy)
    gz = ix * (iy * fz - fy * yx) - yz * (xz * fz - fy * xy) + fx * (xz * yx - iy * xy)
    return -gx / determinant, -gy / determinant, -gz / determinant


@compiled
def rotate(quaternion: FloatArray, wx: float, wy: float, wz: float, dt: float) -> None:
    """Rotate a unit quaternion (x, y, z, w) by the angular velocity (world frame) over `dt`."""
    rate = math.sqrt(wx * wx + wy * wy + wz * wz)
    half = 0.5 * rate * dt
    # sin(half) / rate without cancellation at rest.
    scale = 0.5 * dt - dt**3 * rate * rate / 48.0 if rate < 1e-3 else math.sin(half) / rate
    ax, ay, az, aw = wx * scale, wy * scale, wz * scale, math.cos(half)
    x, y, z, w = quaternion
    quaternion[0] = aw * x + ax * w + ay * z - az * y
    quaternion[1] = aw * y + ay * w + az * x - ax * z
    quaternion[2] = aw * z + az * w + ax * y - ay * x
    quaternion[3] = aw * w - ax * x - ay * y - az * z
    quaternion /= math.sqrt(np.sum(quaternion * quaternion))


@compiled
def integrate(p: Any, motion: FloatArray, wrench: FloatArray) -> None:
    """Move a free body by one physics step under `wrench` (6,), (force, torque)."""
    axes = rotation(motion[3:7])
    tx, ty, tz = gyroscopic_change(p, axes, motion)
    accelerate(p, axes, wrench, DT, motion[7:13])
    for i in range(3):
        motion[10 + i] += tx * axes[0, i] + ty * axes[1, i] + tz * axes[2, i]
        motion[i] += DT * motion[7 + i]
    rotate(motion[3:7], motion[10], motion[11], motion[12], DT)


@compiled
def boxes_overlap(a: FloatArray, b: FloatArray) -> bool:
    """Whether two boxes (x, y, yaw, length, width) overlap, by the separating-axis theorem."""
    dx, dy = b[0] - a[0], b[1] - a[1]
    turn = b[2] - a[2]
    cos, sin = abs(math.cos(turn)), abs(math.sin(turn))
    for yaw, own, other in ((a[2], a, b), (b[2], b, a)):
        along = abs(dx * math.cos(yaw) + dy * math.sin(yaw))
        across = abs(-dx * math.sin(yaw) + dy * math.cos(yaw))
        if along > 0.5 * (own[3] + other[3] * cos + other[4] * sin):
            return False
        if across > 0.5 * (own[4] + other[3] * sin + other[4] * cos):
            return False
    return True


@compiled
def boxes_may_touch(p: Any, motion: FloatArray, dx: float, dy: float, yaw: float) -> bool:
    """Whether the rectangle of a traffic car at the offset (dx, dy) m may touch the ego car's
    within one physics step."""
    forward = rotation(motion[3:7])[0]
    own, other = np.zeros(5), np.zeros(5)
    speed = math.sqrt(motion[7] ** 2 + motion[8] ** 2) + MAX_TRAFFIC_SPEED_M_S
    grown = 2.0 * (speed * DT + CLEARANCE_M)
    own[2] = math.atan2(forward[1], forward[0])
    own[3], own[4] = p.length + grown, p.width + grown
    other[0], other[1], other[2] = dx, dy, yaw
    other[3], other[4] = OTHER_LENGTH, OTHER_WIDTH
    return boxes_overlap(own, other)


@compiled
def contact_possible(
    p: Any,
    table: Table,
    motion: FloatArray,
    piece: int,
    reach: float,
    others: FloatArray,
    move: FloatArray,
    share: float,
) -> bool:
    """Whether the ego car may touch something within one physics step.

    reach: distance (m) of the walls from the track's centre; others (n, 6): ground poses of the
    traffic at the start of the control step; move (n, 6): their change over it; share: fraction of
    the control step already done.
    """
    _, _, d = locate(table, motion[0], motion[1], piece)
    if abs(d) > reach - WALL_RANGE_M:
        return True
    for i in range(others.shape[0]):
        dx = others[i, 0] + share * move[i, 0] - motion[0]
        dy = others[i, 1] + share * move[i, 1] - motion[1]
        if dx * dx + dy * dy < CAR_RANGE_M * CAR_RANGE_M:
            yaw = others[i, 5] + share * move[i, 5]
            if boxes_may_touch(p, motion, dx, dy, yaw):
                return True
    return False


@compiled
def advance_free(
    params: NDArray[Any],
    table: Table,
    ground: Ground,
    motion: FloatArray,
    memory: FloatArray,
    command: FloatArray,
    reach: float,
    others: FloatArray,
    move: FloatArray,
    done: int,
    steps: int,
) -> int:
    """Advance the ego car from physics step `done` of `steps` until it may touch something.

    Returns the number of steps then done.
    """
    wrench = np.empty(6)
    while done < steps:
        share = done / steps
        if contact_possible(
            params[0], table, motion, int(memory[PIECE]), reach, others, move, share
        ):
            return done
        compute_forces(params, table, ground, motion, memory, command, wrench)
        integrate(params[0], motion, wrench)
        done += 1
    return done
