"""Projection through a lens and its inverse, in the camera's frame: x right, y down, z ahead.

Distortion is OpenCV's pinhole model (k1, k2, p1, p2, k3 to k6: calib3d's documentation; Brown 1966)
or OpenCV's fisheye model (k1 to k4 over the angle from the axis: Kannala and Brandt 2006). A
distortion model is used only up to the angle at which the distorted radius stops growing; rays at
larger angles are not projected.
"""

from functools import lru_cache
from math import atan, cos, pi, sin, sqrt
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

if TYPE_CHECKING:
    from trackfeatures.camera import CameraParameters

MAX_ANGLE_RAD = pi / 2 - 1e-3
"""Largest angle between a ray and the optical axis. It is below pi/2, because rays are scaled to
z = 1."""
TABLE = 4096  # number of angles in the table that inverts the radius
STEPS = 8  # largest number of Newton steps; three steps give an error below 1e-12
CONVERGED = 1e-10  # largest error of an undistorted point, in units of the focal length

FloatArray = NDArray[np.float64]


def mount_rotation(roll: float, pitch: float, yaw: float) -> FloatArray:
    """Return the rotation (3, 3) from the car's to the camera's frame, for a camera turned by
    Rz(yaw) Ry(pitch) Rx(roll) relative to the car; angles in rad."""
    cr, sr, cp, sp, cy, sy = cos(roll), sin(roll), cos(pitch), sin(pitch), cos(yaw), sin(yaw)
    ahead = (cy * cp, sy * cp, -sp)
    left = (cy * sp * sr - sy * cr, sy * sp * sr + cy * cr, cp * sr)
    up = (cy * sp * cr + sy * sr, sy * sp * cr - cy * sr, cp * cr)
    return np.array([np.negative(left), np.negative(up), ahead])


def project(camera: "CameraParameters", points: FloatArray) -> FloatArray:
    """Project points (N, 3) in the camera's frame to pixels (N, 2). Pixels are NaN for points
    behind the camera or beyond the angles that the lens model covers."""
    ahead = points[:, 2] > 1e-9
    flat = points[:, :2] / np.where(ahead, points[:, 2], np.nan)[:, None]
    if camera.distortion != "none":
        seen = np.arctan(np.hypot(*flat.T)) < angle_limit(camera.distortion, camera.coefficients)
        distorted, jacobian = _distort(camera, np.where(seen[:, None], flat, np.nan))
        unfolded = jacobian[0, 0] * jacobian[1, 1] > jacobian[0, 1] * jacobian[1, 0]
        flat = np.where(unfolded[:, None], distorted, np.nan)
    k = camera.intrinsics()
    pixels: FloatArray = flat * (k[0, 0], k[1, 1]) + k[:2, 2]
    return pixels


def rays(camera: "CameraParameters", pixels: ArrayLike) -> FloatArray:
    """Return the ray directions (N, 3), with z = 1, of pixels (N, 2) in the camera's frame; NaN
    where no ray maps to a pixel."""
    k = camera.intrinsics()
    flat = (np.asarray(pixels, dtype=np.float64).reshape(-1, 2) - k[:2, 2]) / (k[0, 0], k[1, 1])
    if camera.distortion != "none":
        flat = _undistort(camera, flat)
    return np.column_stack([flat, np.ones(len(flat))])


def _undistort(camera: "CameraParameters", distorted: FloatArray) -> FloatArray:
    """Return undistorted points (N, 2) at z = 1; NaN where the distortion has no inverse."""
    kind, coefficients = camera.distortion, camera.coefficients
    angles, radii = _radius_table(kind, coefficients)
    radius = np.hypot(*distorted.T)
    start = np.tan(np.interp(radius, radii, angles))
    flat = distorted * (start / np.maximum(radius, 1e-12))[:, None]
    with np.errstate(all="ignore"):
        for _ in range(STEPS):
            found, ((a, b), (c, d)) = _distort(camera, flat)
            u, v = (distorted - found).T
            if not np.nanmax(np.abs(distorted - found), initial=0.0) > CONVERGED / 100:
                break
            step = np.column_stack([d * u - b * v, a * v - c * u]) / (a * d - b * c)[:, None]
            flat = flat + step
        found, ((a, b), (c, d)) = _distort(camera, flat)
        good = np.abs(found - distorted).max(1) < CONVERGED * np.maximum(1, radius)
        good &= (a * d > b * c) & (np.arctan(np.hypot(*flat.T)) < angle_limit(kind, coefficients))
    result: FloatArray = np.where(good[:, None], flat, np.nan)
    return result


def _distort(camera: "CameraParameters", flat: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return distorted points (N, 2) of `flat` (N, 2) at z = 1, and the Jacobian (2, 2, N)."""
    x, y = flat.T
    square = x * x + y * y
    p1 = p2 = 0.0
    if camera.distortion == "fisheye":
        scale, slope = _fisheye_scale(square, camera.coefficients)
    else:
        k = _padded(camera.coefficients)
        p1, p2 = k[2], k[3]
        above, below = _rational(k)
        n, d = np.polyval(above, square), np.polyval(below, square)
        scale = n / d
        slope = np.polyval(np.polyder(above), square)
        slope = (slope - scale * np.polyval(np.polyder(below), square)) / d
    moved = np.column_stack(
        [
            x * scale + 2 * p1 * x * y + p2 * (square + 2 * x * x),
            y * scale + p1 * (square + 2 * y * y) + 2 * p2 * x * y,
        ]
    )
    mixed = 2 * x * y * slope + 2 * p1 * x + 2 * p2 * y
    jacobian = np.array(
        [
            [scale + 2 * x * x * slope + 2 * p1 * y + 6 * p2 * x, mixed],
            [mixed, scale + 2 * y * y * slope + 6 * p1 * y + 2 * p2 * x],
        ]
    )
    return moved, jacobian


def _fisheye_scale(
    square: FloatArray, coefficients: tuple[float, ...]
) -> tuple[FloatArray, FloatArray]:
    """Return the ratio (N,) of the distorted radius to the undistorted radius r at z = 1, and the
    derivative (N,) of this ratio with respect to r^2, for `square` = r^2 (N,)."""
    r = np.sqrt(square)
    small = r < 1e-4
    safe = np.where(small, 1.0, r)
    angle = np.arctan(safe)
    polynomial = _angle_polynomial(coefficients)
    radius, slope = np.polyval(polynomial, angle), np.polyval(np.polyder(polynomial), angle)
    k1 = coefficients[0]  # near 0 the series of arctan gives the radius r + (k1 - 1/3) r^3
    scale = np.where(small, 1 + (k1 - 1 / 3) * square, radius / safe)
    by_square = (slope / (1 + safe * safe) - radius / safe) / (2 * safe * safe)
    return scale, np.where(small, k1 - 1 / 3, by_square)


def _padded(coefficients: tuple[float, ...]) -> tuple[float, ...]:
    return (*coefficients, *(0.0,) * (8 - len(coefficients)))


def _rational(k: tuple[float, ...]) -> tuple[list[float], list[float]]:
    """Return numerator and denominator of the radial factor of OpenCV's model, as polynomials in
    r^2, highest power first. `k` has the eight coefficients."""
    return [k[4], k[1], k[0], 1.0], [k[7], k[6], k[5], 1.0]


def _angle_polynomial(coefficients: tuple[float, ...]) -> list[float]:
    """Return the distorted radius of the fisheye model as a polynomial of the angle from the axis,
    highest power first."""
    k1, k2, k3, k4 = coefficients
    return [k4, 0.0, k3, 0.0, k2, 0.0, k1, 0.0, 1.0, 0.0]


@lru_cache(maxsize=64)
def angle_limit(kind: str, coefficients: tuple[float, ...]) -> float:
    """Return the angle from the optical axis in rad at which the distorted radius stops growing.
    `kind` is the distortion model ("opencv" or "fisheye"), `coefficients` are the coefficients of
    this model."""
    if kind == "fisheye":
        limits = _positive_roots(np.polyder(_angle_polynomial(coefficients)))
        return min([*limits, MAX_ANGLE_RAD])
    above, below = _rational(_padded(coefficients))
    double = [2.0, 0.0]  # 2 r^2
    growth = np.polymul(np.polyadd(above, np.polymul(double, np.polyder(above))), below)
    growth = np.polysub(growth, np.polymul(np.polymul(double, above), np.polyder(below)))
    squares = [*_positive_roots(growth), *_positive_roots(np.array(below))]
    return min([*(atan(sqrt(square)) for square in squares), MAX_ANGLE_RAD])


def _positive_roots(polynomial: NDArray[np.floating[Any]]) -> list[float]:
    """Return the positive real roots of `polynomial` (highest power first)."""
    found = np.roots(polynomial)
    real = found[np.abs(found.imag) < 1e-9 * np.maximum(1, np.abs(found))].real
    return [float(root) for root in real if root > 0]


@lru_cache(maxsize=64)
def _radius_table(kind: str, coefficients: tuple[float, ...]) -> tuple[FloatArray, FloatArray]:
    """Return angles from the axis (TABLE,) in rad up to `angle_limit`, and the distorted radii
    (TABLE,) at these angles."""
    angles = np.linspace(0.0, angle_limit(kind, coefficients), TABLE)
    if kind == "fisheye":
        return angles, np.asarray(np.polyval(_angle_polynomial(coefficients), angles), np.float64)
    square = np.tan(angles) ** 2
    above, below = _rational(_padded(coefficients))
    radii = np.sqrt(square) * np.polyval(above, square) / np.polyval(below, square)
    return angles, np.maximum.accumulate(radii)
