"""Computes distances, angle and curvature of a lane's two markings from points in a picture.

The road is assumed to be flat and the markings parallel. In the track frame at the car (x along the
road, y to the left, both in m) a marking `d` m to the right is at y = curvature * x^2 / 2 - d. A
pixel [u, v] of the whole picture has u to the right and v down.
"""

from dataclasses import dataclass, replace
from math import atan2, degrees, radians

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mtlnet.inference.overlay import marking_line
from trackfeatures.camera import CameraParameters
from trackfeatures.errors import UserError
from trackfeatures.lens import mount_rotation

MAX_STEPS = 40
CONVERGED = 1e-10
DIFFERENCE = 1e-6  # step of the numerical derivatives
MAX_PITCH_DEG = 30.0
PITCHES_DEG = np.concatenate([[0.0], np.linspace(-4.0, 4.0, 33)])
"""Starting points of the search for the pitch, degrees, relative to the pitch at which straight
markings would meet at the horizon."""
LINE_ALONG_M = np.geomspace(1.5, 80.0, 80)
FAR_HANDLE_M = 25.0
MARGIN = 0.03
"""Least distance of handles from the edges of the picture, as a share of its width or height."""


class MarkingsError(UserError):
    """The points do not lie on two parallel markings on a flat road."""


@dataclass(frozen=True)
class Markings:
    """The lane's markings at the car: distances ml and mr (m, negative to the left), angle (rad,
    positive when the car points to the right), curvature (1/m, positive to the left), and the
    camera's pitch in this picture (degrees, positive downwards)."""

    ml: float
    mr: float
    angle: float
    curvature: float
    pitch_deg: float


def fit_markings(
    camera: CameraParameters,
    left: ArrayLike,
    right: ArrayLike,
    curvature: float | None = 0.0,
    pitch_deg: float | None = None,
) -> Markings:
    """Fit a lane's markings to points on the left and on the right marking, each (N, 2) in px of
    the pictures of `camera`, and return them. The fit minimises the squares of the points' lateral
    distances from the markings, converted to px.

    `curvature` is in 1/m; with None it is fitted too, which needs a third point on either marking.
    `pitch_deg` is the camera's pitch in degrees; with None it is fitted too, from the point where
    the markings would meet. Raises MarkingsError.
    """
    points = [np.asarray(side, np.float64).reshape(-1, 2) for side in (left, right)]
    if min(map(len, points)) < 2:
        raise MarkingsError("each marking needs two points; drag both of its handles")
    free = np.array([True, True, True, curvature is None, pitch_deg is None])
    sides = np.repeat([0, 1], [len(side) for side in points])
    pixels = np.concatenate(points)
    pitches: list[float]
    if pitch_deg is None:
        pitches = (_meeting_pitch(camera, *points) + PITCHES_DEG).tolist()
    else:
        pitches = [pitch_deg]
    starts = [np.array([-1.8, 1.8, 0.0, curvature or 0.0, pitch]) for pitch in pitches]
    # At a fixed pitch the other values are almost linear, so the search starts at the best pitch.
    inner = free & [True, True, True, True, False]
    found = [_refine(camera, pixels, sides, start, inner, steps=3) for start in starts]
    best = min(found, key=lambda each: each[0])
    cost, values = _refine(camera, pixels, sides, best[1], free, MAX_STEPS)
    if not np.isfinite(cost):
        raise MarkingsError("a point lies at or above the horizon; drag it down onto the road")
    ml, mr, angle, bend, pitch = values.tolist()
    if abs(angle) > 1 or abs(pitch) > MAX_PITCH_DEG or abs(bend) > 0.2:
        raise MarkingsError("these points do not lie on two parallel markings of a road ahead")
    return Markings(ml, mr, angle, bend, pitch)


def _refine(
    camera: CameraParameters,
    pixels: NDArray[np.float64],
    sides: NDArray[np.int64],
    values: NDArray[np.float64],
    free: NDArray[np.bool_],
    steps: int,
) -> tuple[float, NDArray[np.float64]]:
    """Fit those of the five `values` (ml and mr in m, angle in rad, curvature in 1/m, pitch in
    degrees) that the mask `free` (5,) selects, by the Levenberg-Marquardt method. Returns the sum
    of the squared residuals, px^2, and all five values.

    The sum is infinite if a point is not on the road; a search that starts with an infinite sum
    ends with an infinite sum. `sides` (N,): 0 for points on the left marking, 1 for the right.
    """
    names = np.flatnonzero(free)
    residual = _residuals(camera, pixels, sides, values)
    cost, damping = float(residual @ residual), 1e-6
    for _ in range(steps):
        if not np.isfinite(cost):
            break
        columns = []
        for i in names.tolist():
            moved = values.copy()
            moved[i] += DIFFERENCE
            columns.append((_residuals(camera, pixels, sides, moved) - residual) / DIFFERENCE)
        jacobian = np.column_stack(columns)
        if not np.isfinite(jacobian).all():
            return np.inf, values
        squares = jacobian.T @ jacobian
        squares += damping * np.diag(np.diag(squares) + 1e-12)
        step = np.linalg.lstsq(squares, -jacobian.T @ residual, rcond=None)[0]
        tried = values.copy()
        tried[names] += step
        there = _residuals(camera, pixels, sides, tried)
        if float(there @ there) <= cost:
            values, residual, cost = tried, there, float(there @ there)
            damping = max(damping / 10, 1e-12)
            if np.abs(step).max() < CONVERGED:
                break
        else:
            damping *= 10
    return cost, values


def _residuals(
    camera: CameraParameters,
    pixels: NDArray[np.float64],
    sides: NDArray[np.int64],
    values: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Return the lateral distances (N,) of the points `pixels` (N, 2) from their marking, converted
    to px; infinite above the horizon. `sides` and `values`: as for `_refine`."""
    ml, mr, angle, curvature, pitch = values.tolist()
    x, y = replace(camera, pitch_deg=pitch).road_points(pixels).T
    along = x * np.cos(angle) + y * np.sin(angle)
    left = y * np.cos(angle) - x * np.sin(angle)
    away = left + np.where(sides == 0, ml, mr) - curvature * along**2 / 2
    distance = np.maximum(np.hypot(x - camera.x, y - camera.y), 0.5)
    pixels_away = away * camera.focal_px / distance
    return np.where(np.isfinite(pixels_away), pixels_away, np.inf)


def _meeting_pitch(
    camera: CameraParameters, left: NDArray[np.float64], right: NDArray[np.float64]
) -> float:
    """Return the pitch (degrees) at which the straight lines through both markings are level.

    Each marking and the optical centre span a plane; both planes contain the road's direction
    (Hartley and Zisserman 2004, section 8.6).
    """
    normals = []
    for side in (left, right):
        first, last = camera.rays(side[[0, -1]])
        normals.append(np.cross(first, last))
    direction = np.cross(normals[0], normals[1])
    direction *= np.sign(direction[2])
    unpitched = mount_rotation(radians(camera.roll_deg), 0.0, 0.0)
    ahead, _, up = direction @ unpitched
    if not ahead > 0:
        raise MarkingsError("the two markings do not meet ahead; drag the far handles together")
    pitch = degrees(atan2(up, ahead))
    if abs(pitch) > MAX_PITCH_DEG:
        raise MarkingsError(
            f"the markings meet where a camera with a pitch of {pitch:.0f} degrees has its "
            "horizon; drag the far handles"
        )
    return pitch


def marking_pixels(
    camera: CameraParameters, markings: Markings, along: ArrayLike = LINE_ALONG_M
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the pixels (N, 2) of the left and of the right marking at the distances `along` (N,)
    along the road, in m; NaN where the camera does not see them."""
    source = replace(camera, pitch_deg=markings.pitch_deg)
    found = []
    for distance in (markings.ml, markings.mr):
        line = marking_line(distance, markings.angle, markings.curvature, along)
        road = np.column_stack([line, np.full(len(line), -camera.cg_height_m)])
        found.append(source.project(road))
    return found[0], found[1]


def handles(camera: CameraParameters, markings: Markings) -> dict[str, list[list[float]]]:
    """Return the points by which a user drags the markings: for "left" and "right" three pixels
    [u, v], near, middle and far (at most 25 m away).

    Where a marking leaves the picture, its points lie near the picture's edge. Raises MarkingsError
    for markings behind the camera.
    """
    size = np.array([camera.width - 1, camera.height - 1], np.float64)
    found = {}
    for name, pixels in zip(("left", "right"), marking_pixels(camera, markings), strict=True):
        seen = np.isfinite(pixels).all(1) & (LINE_ALONG_M <= FAR_HANDLE_M)
        inside = seen & ((pixels >= MARGIN * size) & (pixels <= (1 - MARGIN) * size)).all(1)
        rows = np.flatnonzero(inside if inside.sum() >= 3 else seen)
        if len(rows) < 3:
            raise MarkingsError("the markings lie behind the camera")
        chosen = pixels[[rows[0], rows[len(rows) // 2], rows[-1]]]
        found[name] = np.clip(chosen, MARGIN * size, (1 - MARGIN) * size).tolist()
    return found
