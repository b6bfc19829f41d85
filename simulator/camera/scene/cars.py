"""Draws the cars: one triangle mesh at each car's pose, and the shadow on the ground below it.

Car frame: x ahead, y left, z up, metres; the origin is on the ground below the middle of the car. A
vertex is position, normal and colour; the colour (-1, -1, -1) is replaced by the car's paint.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from simulator.arrays import FloatArray
from simulator.camera.core.context import Graphics
from simulator.camera.core.mesh import vertex_arrays
from simulator.camera.core.optics import rotation
from simulator.camera.scene.light import Light
from simulator.camera.scene.solids import PLAIN, face

Point = tuple[float, float, float]

LENGTH_M, WIDTH_M, HEIGHT_M = 4.4, 1.8, 1.4
REACH_M, NEAR_M = 350.0, 40.0
SHADOW_REACH_M = 120.0
_RADIUS_M = 3.0
_LONGEST_SHADOW = 4.0
"""Largest length of a shadow, as a multiple of the car's height."""

PAINTS: tuple[Point, ...] = (
    (0.42, 0.025, 0.022), (0.03, 0.07, 0.28), (0.62, 0.62, 0.60), (0.035, 0.036, 0.04),
    (0.30, 0.31, 0.32), (0.55, 0.40, 0.05), (0.03, 0.16, 0.07), (0.20, 0.10, 0.05),
)  # fmt: skip
_OWN: Point = (-1.0, -1.0, -1.0)
_GLASS, _RUBBER, _RIM = (0.022, 0.03, 0.038), (0.012, 0.012, 0.013), (0.32, 0.32, 0.33)
_TAIL, _HEAD, _PLATE, _DARK = (0.5, 0.01, 0.01), (0.85, 0.85, 0.78), (0.7, 0.7, 0.66), (0.02,) * 3

# Side outlines of body and cabin, from rear to front: x, z and half the width there, in m.
_BODY = ((-2.2, 0.42, 0.78), (-2.18, 0.92, 0.82), (-1.35, 0.98, 0.9), (0.75, 0.94, 0.9),
         (1.9, 0.74, 0.84), (2.2, 0.55, 0.74), (2.2, 0.3, 0.74))  # fmt: skip
_CABIN = ((-1.75, 0.95, 0.78), (-1.05, 1.38, 0.62), (0.05, 1.4, 0.62), (0.95, 0.92, 0.78))
# Lights, number plate and bumpers: x, then y from and to, z from and to, in m, and the colour.
_REAR_X, _FRONT_X = -2.225, 2.225
_PANELS = (
    (_REAR_X, 0.78, 0.48, 0.66, 0.84, _TAIL), (_FRONT_X, 0.78, 0.48, 0.5, 0.62, _HEAD),
    (_REAR_X, -0.48, -0.78, 0.66, 0.84, _TAIL), (_FRONT_X, -0.48, -0.78, 0.5, 0.62, _HEAD),
    (_REAR_X, 0.26, -0.26, 0.62, 0.73, _PLATE), (_REAR_X, 0.78, -0.78, 0.19, 0.42, _DARK),
    (_FRONT_X, 0.6, -0.6, 0.3, 0.44, _DARK),
)  # fmt: skip
_WHEELS_X, _WHEEL_RADIUS = (-1.35, 1.32), 0.33


@dataclass(frozen=True)
class CarMesh:
    """Triangles of a car in two levels of detail.

    `vertices` (3 T, 9) float32: three vertices for each of the T triangles of both levels, each
    with position, normal and colour. The order is: detailed wheels, body, simple wheels. A near car
    is drawn with the first `near` vertices (detailed wheels and body), a distant car with the
    vertices from index `far` to the end (body and simple wheels). So both levels contain the body,
    which lies between `far` and `near`.
    """

    vertices: NDArray[np.float32]
    near: int
    far: int


def car_mesh() -> CarMesh:
    """Build the car's triangles in both levels of detail."""
    wheels, far_wheels = (
        [part for x in _WHEELS_X for side in (-1.0, 1.0) for part in wheel(x, side)]
        for wheel in (_wheel, _far_wheel)
    )
    body = [*_hull(_BODY, 0.22, _OWN, _OWN), *_cabin(), *_fittings()]
    near = sum(map(len, wheels)) + sum(map(len, body))
    vertices = np.concatenate([*wheels, *body, *far_wheels]).astype(np.float32)
    return CarMesh(vertices, near, sum(map(len, wheels)))


def _face(points: Sequence[Point], colour: Point) -> FloatArray:
    """Return two triangles (6, 9); the four corners are counter-clockwise seen from outside."""
    corners = [np.array(point) for point in points]
    return face(corners, [(0.0, 0.0)] * 4, colour, PLAIN)[:, :9]


def _hull(outline: tuple[Point, ...], floor: float, top: Point, flank: Point) -> list[FloatArray]:
    """Build a prism below `outline`, points (x, z, half width) in m from rear to front. It extends
    down to z = `floor` (m). `top` is the colour of its top, rear and front, `flank` of its
    sides."""
    parts = []
    for (x0, z0, w0), (x1, z1, w1) in pairwise(outline):
        parts.append(_face([(x0, w0, z0), (x0, -w0, z0), (x1, -w1, z1), (x1, w1, z1)], top))
        for side in (1.0, -1.0):
            corners = [
                (x0, side * w0, floor), (x0, side * w0, z0), (x1, side * w1, z1),
                (x1, side * w1, floor),
            ]  # fmt: skip
            parts.append(_face(corners if side > 0 else corners[::-1], flank))
    x, z, w = outline[0]
    parts.append(_face([(x, w, floor), (x, -w, floor), (x, -w, z), (x, w, z)], top))
    x, z, w = outline[-1]
    parts.append(_face([(x, w, z), (x, -w, z), (x, -w, floor), (x, w, floor)], top))
    return parts


def _cabin() -> list[FloatArray]:
    """Build the cabin: windows on all sides under a painted roof."""
    parts = []
    for k, (back, front) in enumerate(pairwise(_CABIN)):
        (x0, z0, w0), (x1, z1, w1) = back, front
        colour = _OWN if k == 1 else _GLASS
        parts.append(_face([(x0, w0, z0), (x0, -w0, z0), (x1, -w1, z1), (x1, w1, z1)], colour))
    base = 0.94
    for side in (1.0, -1.0):
        rear, roof0, roof1, front = ((x, side * w, z) for x, z, w in _CABIN)
        foot0, foot1 = (roof0[0], side * 0.78, base), (roof1[0], side * 0.78, base)
        for corners in (
            [foot0, roof0, rear, rear],
            [foot1, roof1, roof0, foot0],
            [front, front, roof1, foot1],
        ):
            parts.append(_face(corners if side < 0 else corners[::-1], _GLASS))
    return parts


def _wheel(x: float, side: float) -> list[FloatArray]:
    """Build a wheel at `x` (m) on one side (`side` 1 left, -1 right): a tyre with ten faces and a
    rim, projecting from the flank."""
    parts = []
    outer, inner = side * 0.91, side * 0.68
    angles = np.linspace(0.0, 2.0 * np.pi, 11)
    for a, b in pairwise(angles):
        ring = [
            (x + r * np.cos(t), r * np.sin(t) + _WHEEL_RADIUS)
            for r in (_WHEEL_RADIUS, 0.2)
            for t in (a, b)
        ]
        (ax, az), (bx, bz), (cx, cz), (dx, dz) = ring
        parts.append(
            _face([(ax, inner, az), (bx, inner, bz), (bx, outer, bz), (ax, outer, az)], _RUBBER)
        )
        face = [(ax, outer, az), (bx, outer, bz), (dx, outer, dz), (cx, outer, cz)]
        hub = [
            (cx, outer, cz),
            (dx, outer, dz),
            (x, outer, _WHEEL_RADIUS),
            (x, outer, _WHEEL_RADIUS),
        ]
        for corners, colour in ((face, _RUBBER), (hub, _RIM)):
            parts.append(_face(corners if side < 0 else corners[::-1], colour))
    return parts


def _far_wheel(x: float, side: float) -> list[FloatArray]:
    """Build a wheel at `x` (m) on one side (`side` 1 left, -1 right) as one dark face with six
    corners."""
    y = side * 0.91
    ring = [
        (x + _WHEEL_RADIUS * np.cos(t), y, _WHEEL_RADIUS * (1.0 + np.sin(t)))
        for t in np.linspace(0.0, 2.0 * np.pi, 7)
    ]
    halves = ([ring[k] for k in (0, 1, 2, 3)], [ring[k] for k in (3, 4, 5, 0)])
    return [_face(half if side < 0 else half[::-1], _RUBBER) for half in halves]


def _fittings() -> list[FloatArray]:
    """Build lights, number plates and bumpers, 2.5 cm in front of the body."""
    parts = []
    for x, y0, y1, z0, z1, colour in _PANELS:
        corners = [(x, y0, z0), (x, y1, z0), (x, y1, z1), (x, y0, z1)]
        parts.append(_face(corners if x < 0.0 else corners[::-1], colour))
    return parts


class Cars:
    """Draws cars with one mesh in graphics memory, which all cameras of a process share."""

    def __init__(self, graphics: Graphics, *features: str) -> None:
        context = graphics.context
        program = graphics.weather_program("car", "", *features)
        self._stands = [
            graphics.uniform(name, "stand") for name in (program, graphics.label_program("car"))
        ]
        self._paint = graphics.uniform(program, "paint")
        self._spot = {
            name: graphics.uniform("spot", name) for name in ("stand", "shadow_extent", "middle")
        }
        self._context = context
        mesh = car_mesh()
        triangles = context.buffer(mesh.vertices.tobytes())
        self._near, self._far = (0, mesh.near), (mesh.far, len(mesh.vertices) - mesh.far)
        self._meshes = vertex_arrays(
            graphics, program, triangles, None, ("3f 3f 3f", "at", "facing", "colour")
        )
        corners = np.array([-1, -1, 1, -1, -1, 1, 1, 1], dtype=np.float32)
        patch = context.buffer(corners.tobytes())
        self._patch = context.vertex_array(graphics.programs["spot"], [(patch, "2f", "corner")])

    def visible(self, poses: FloatArray, eye: FloatArray, planes: FloatArray) -> NDArray[np.intp]:
        """Return the indices of the cars that are in the view frustum and within 350 m, nearest
        first. `poses` (n, 6) are in m and rad, world. `eye` (3,), m, is the viewpoint, `planes`
        (4, 3) are the inward normals of the side planes."""
        if len(poses) == 0:
            return np.empty(0, dtype=np.intp)
        relative = poses[:, :3] - eye
        distance = np.linalg.norm(relative, axis=1)
        inside = (relative @ planes.T > -2.0 * _RADIUS_M).all(axis=1) & (distance < REACH_M)
        return np.flatnonzero(inside)[np.argsort(distance[inside], kind="stable")]

    def draw(self, poses: FloatArray, paints: list[int], eye: FloatArray, labels: bool) -> None:
        """Draw the cars at `poses` (n, 6; m, rad), as depth and class if `labels`, else as colours.
        `paints` are the cars' indices into PAINTS, `eye` (3,), m, is the viewpoint."""
        for pose, paint in zip(poses, paints, strict=True):
            self._stands[labels].write(_model_matrix(pose, eye).tobytes())
            self._paint.value = PAINTS[paint % len(PAINTS)]
            near = np.linalg.norm(pose[:3] - eye) < NEAR_M
            first, count = self._near if near else self._far
            self._meshes[labels].render(vertices=count, first=first)

    def draw_shadows(self, poses: FloatArray, eye: FloatArray, light: Light) -> None:
        """Draw the shadows on the ground of the cars at `poses` (n, 6; m, rad) within 120 m of
        `eye` (3,), m. Blending must be enabled."""
        x, y, z = light.sun_direction
        fall = np.array([-x, -y]) / max(z, 1e-3)
        fall *= min(1.0, _LONGEST_SHADOW / max(float(np.hypot(*fall)), 1e-9))
        for pose in poses:
            if np.linalg.norm(pose[:3] - eye) > SHADOW_REACH_M:
                continue
            cos, sin = np.cos(pose[5]), np.sin(pose[5])
            run = np.array([cos * fall[0] + sin * fall[1], -sin * fall[0] + cos * fall[1]])
            self._spot["stand"].write(_model_matrix(pose, eye).tobytes())
            self._spot["shadow_extent"].value = (*run, *(np.array([2.9, 1.6]) + 0.7 * np.abs(run)))
            self._spot["middle"].value = tuple(0.7 * run)
            self._patch.render(self._context.TRIANGLE_STRIP)


@lru_cache(maxsize=2)
def shared_cars(graphics: Graphics, *features: str) -> Cars:
    """Return the `Cars` of `graphics`, created at first use. `features` are the #defines of the
    program that draws the cars, such as "night"."""
    return Cars(graphics, *features)


def _model_matrix(pose: FloatArray, eye: FloatArray) -> NDArray[np.float32]:
    """Return the matrix (4, 4) from the frame of the car at `pose` (6,) to the world frame shifted
    to the eye, column-major for OpenGL."""
    matrix = np.eye(4)
    matrix[:3, :3] = rotation(float(pose[3]), float(pose[4]), float(pose[5]))
    matrix[:3, 3] = pose[:3] - eye
    return np.ascontiguousarray(matrix.T, dtype=np.float32)
