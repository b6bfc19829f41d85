"""Trees on the graphics card: the nearest seen ones, each a picture that turns to the eye.

What of a tree is opaque is drawn first, the nearest first, so that it hides what is behind it; its
soft edges come after all else, the farthest first, and are blended.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from simulator.camera.core.context import Graphics
from simulator.camera.core.frustum_culling import balls_seen, fans
from simulator.camera.vegetation import foliage
from simulator.camera.vegetation.foliage import CORNERS
from simulator.camera.vegetation.scenery import Trees

FloatArray = NDArray[np.float64]
Part = Literal["core", "fringe", "labels"]

REACH_M = 420.0
MOST = 160
"""Trees drawn at once; the farthest are left out."""
NEAR_M = 80.0
"""Nearer trees are drawn in two parts and within their outline, which has more corners than the
whole picture; beyond, that would cost more than it saves."""
_SQUARE = ((-0.5, 0.0), (0.5, 0.0), (0.5, 1.0), (-0.5, 1.0))
_SQUARE_FAN = np.array([[0, 1, 2], [0, 2, 3]])
_OUTLINE_FAN = 4 + np.array([[0, k, k + 1] for k in range(1, CORNERS - 1)])


@dataclass(frozen=True)
class Corners:
    """Indices of the corners of triangles (n, 3), the nearest tree's first; the first `near` of
    them are those of near trees."""

    corners: NDArray[np.uint32]
    near: int


class Woods:
    """All trees of a scene."""

    def __init__(self, graphics: Graphics, trees: Trees, weather: str) -> None:
        self._feet = trees.feet
        self._size = np.maximum(trees.width, trees.height)
        count = len(trees.feet)
        self._corners = 4 + CORNERS
        vertices = np.empty((count, self._corners, 11), dtype=np.float32)
        vertices[:, :, 0:3] = trees.feet[:, None]
        vertices[:, :, 3] = trees.width[:, None]
        vertices[:, :, 4] = trees.height[:, None]
        vertices[:, :, 5] = trees.cell[:, None]
        vertices[:, :, 6:9] = trees.tint[:, None]
        vertices[:, :4, 9:11] = _SQUARE
        vertices[:, 4:, 9:11] = foliage.outlines()[trees.cell]
        context = graphics.context
        self._vertices = context.buffer(vertices.tobytes() or bytes(4))
        self._indices = context.buffer(reserve=MOST * _OUTLINE_FAN.size * 4, dynamic=True)
        programs: dict[Part, str] = {
            "core": graphics.weathered("tree", weather, "core"),
            "fringe": graphics.weathered("tree", weather),
            "labels": graphics.labelling("tree"),
        }
        self._arrays = {
            part: context.vertex_array(
                graphics.programs[program],
                [(self._vertices, "3f 3f 3f 2f", "at", "shape", "tint", "corner")],
                index_buffer=self._indices,
                index_element_size=4,
                skip_errors=part == "labels",
            )
            for part, program in programs.items()
        }

    def seen(self, eye: FloatArray, planes: FloatArray, from_above: bool) -> Corners:
        """What to draw for an eye."""
        trees = balls_seen(self._feet, self._size, REACH_M, MOST, eye, planes)
        squared = ((self._feet[trees] - eye) ** 2).sum(axis=1)
        near = int(np.searchsorted(squared, NEAR_M**2))
        # Seen from above, a tree is a crown of another outline.
        fan = _SQUARE_FAN if from_above else _OUTLINE_FAN
        return Corners(
            fans(trees, near, self._corners, fan, _SQUARE_FAN),
            near * len(fan),
        )

    def draw(self, seen: Corners, part: Part) -> None:
        """Draw the seen trees: the "core" of the near ones, then, blended over all else, the
        "fringe" and the far ones whole; or all of them at once as "labels"."""
        corners = seen.corners[: seen.near] if part == "core" else seen.corners
        if len(corners) == 0:
            return
        order = corners[::-1] if part == "fringe" else corners
        self._indices.orphan()
        self._indices.write(order.tobytes())
        self._arrays[part].render(vertices=order.size)

    def release(self) -> None:
        """Free the graphics memory."""
        for array in self._arrays.values():
            array.release()
        self._indices.release()
        self._vertices.release()
