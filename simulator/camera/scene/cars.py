"""Cars and the shadows under them, drawn at their poses."""

from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from simulator.camera.core.context import Graphics
from simulator.camera.core.mesh import both_ways
from simulator.camera.core.optics import rotation
from simulator.camera.scene.carmesh import PAINTS, car_mesh
from simulator.camera.scene.light import Light

FloatArray = NDArray[np.float64]

REACH_M, NEAR_M = 350.0, 40.0
SHADOW_REACH_M = 120.0
_RADIUS_M = 3.0
_LONGEST_SHADOW = 4.0
"""A low sun draws shadows out to at most this times the height."""


class Cars:
    """The car mesh of a process and what draws it."""

    def __init__(self, graphics: Graphics) -> None:
        context = graphics.context
        self._stands = [
            graphics.uniform(name, "stand") for name in ("car", graphics.labelling("car"))
        ]
        self._paint = graphics.uniform("car", "paint")
        self._spot = {name: graphics.uniform("spot", name) for name in ("stand", "reach", "middle")}
        self._context = context
        mesh = car_mesh()
        triangles = context.buffer(mesh.vertices.tobytes())
        self._near, self._far = (0, mesh.near), (mesh.far, len(mesh.vertices) - mesh.far)
        self._meshes = both_ways(
            graphics, "car", triangles, None, ("3f 3f 3f", "at", "facing", "colour")
        )
        corners = np.array([-1, -1, 1, -1, -1, 1, 1, 1], dtype=np.float32)
        patch = context.buffer(corners.tobytes())
        self._patch = context.vertex_array(graphics.programs["spot"], [(patch, "2f", "corner")])

    def seen(self, poses: FloatArray, eye: FloatArray, planes: FloatArray) -> NDArray[np.intp]:
        """Which cars of `poses` (n, 6) may show, nearest first."""
        if len(poses) == 0:
            return np.empty(0, dtype=np.intp)
        relative = poses[:, :3] - eye
        distance = np.linalg.norm(relative, axis=1)
        inside = (relative @ planes.T > -2.0 * _RADIUS_M).all(axis=1) & (distance < REACH_M)
        return np.flatnonzero(inside)[np.argsort(distance[inside], kind="stable")]

    def draw(self, poses: FloatArray, paints: list[int], eye: FloatArray, labels: bool) -> None:
        """The bodies at `poses` (n, 6), in the paints of these numbers."""
        for pose, paint in zip(poses, paints, strict=True):
            self._stands[labels].write(_stand(pose, eye).tobytes())
            self._paint.value = PAINTS[paint % len(PAINTS)]
            near = np.linalg.norm(pose[:3] - eye) < NEAR_M
            first, count = self._near if near else self._far
            self._meshes[labels].render(vertices=count, first=first)

    def draw_shadows(self, poses: FloatArray, eye: FloatArray, light: Light) -> None:
        """The shadows on the ground; blending must be on."""
        x, y, z = light.sun_direction
        fall = np.array([-x, -y]) / max(z, 1e-3)
        fall *= min(1.0, _LONGEST_SHADOW / max(float(np.hypot(*fall)), 1e-9))
        for pose in poses:
            if np.linalg.norm(pose[:3] - eye) > SHADOW_REACH_M:
                continue
            cos, sin = np.cos(pose[5]), np.sin(pose[5])
            run = np.array([cos * fall[0] + sin * fall[1], -sin * fall[0] + cos * fall[1]])
            self._spot["stand"].write(_stand(pose, eye).tobytes())
            self._spot["reach"].value = (*run, *(np.array([2.9, 1.6]) + 0.7 * np.abs(run)))
            self._spot["middle"].value = tuple(0.7 * run)
            self._patch.render(self._context.TRIANGLE_STRIP)


def cars_of(graphics: Graphics) -> Cars:
    """The cars of this graphics, made on first use."""
    if graphics not in _made:
        _made[graphics] = Cars(graphics)
    return _made[graphics]


_made: WeakKeyDictionary[Graphics, Cars] = WeakKeyDictionary()


def _stand(pose: FloatArray, eye: FloatArray) -> NDArray[np.float32]:
    """Car frame to eye-relative world, (4, 4), column by column as GL wants it."""
    matrix = np.eye(4)
    matrix[:3, :3] = rotation(float(pose[3]), float(pose[4]), float(pose[5]))
    matrix[:3, 3] = pose[:3] - eye
    return np.ascontiguousarray(matrix.T, dtype=np.float32)
