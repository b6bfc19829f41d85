"""Rigid-body motion of a free car, one compiled physics step at a time.

The integration scheme is PyBullet's (semi-implicit Euler, exact rotation), so that the result is
the same whether PyBullet or this code moves the body. World frame, SI units. `p` is the record
`CarParameters.packed()[0]`.
"""

import math
from typing import Any

from runtime.jit import inlined
from simulator.arrays import FloatArray
from simulator.vehicle.dynamics import DT, accelerate


@inlined
def gyroscopic_change(p: Any, axes: FloatArray, motion: FloatArray) -> tuple[float, float, float]:
    """Return the change of the angular velocity (body frame, rad/s) in one torque-free step of
    Euler's equations: one Newton step of the implicit rule, as in PyBullet (Catto, GDC 2015).
    `axes` (3, 3) has the body axes as rows; `motion` (13,): see `dynamics.MOTION`."""
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


@inlined
def rotate(quaternion: FloatArray, wx: float, wy: float, wz: float, dt: float) -> None:
    """Rotate a unit quaternion (x, y, z, w), in place, by the world angular velocity (wx, wy, wz)
    in rad/s over `dt` s."""
    rate = math.sqrt(wx * wx + wy * wy + wz * wz)
    half = 0.5 * rate * dt
    # `scale` is sin(half) / rate, without cancellation at rest.
    scale = 0.5 * dt - dt**3 * rate * rate / 48.0 if rate < 1e-3 else math.sin(half) / rate
    ax, ay, az, aw = wx * scale, wy * scale, wz * scale, math.cos(half)
    x, y, z, w = quaternion[0], quaternion[1], quaternion[2], quaternion[3]
    quaternion[0] = aw * x + ax * w + ay * z - az * y
    quaternion[1] = aw * y + ay * w + az * x - ax * z
    quaternion[2] = aw * z + az * w + ax * y - ay * x
    quaternion[3] = aw * w - ax * x - ay * y - az * z
    x, y, z, w = quaternion[0], quaternion[1], quaternion[2], quaternion[3]
    length = math.sqrt(x * x + y * y + z * z + w * w)
    for i in range(4):
        quaternion[i] /= length


@inlined
def integrate(p: Any, axes: FloatArray, motion: FloatArray, wrench: FloatArray) -> None:
    """Move a free body with the `axes` (3, 3) by one physics step of 1/200 s under `wrench` (6,),
    (force, torque). Updates `motion` (13,): position, quaternion, velocity, angular velocity."""
    tx, ty, tz = gyroscopic_change(p, axes, motion)
    accelerate(p, axes, wrench, DT, motion[7:13])
    for i in range(3):
        motion[10 + i] += tx * axes[0, i] + ty * axes[1, i] + tz * axes[2, i]
        motion[i] += DT * motion[7 + i]
    rotate(motion[3:7], motion[10], motion[11], motion[12], DT)
