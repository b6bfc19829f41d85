"""Drawing of trees: the nearest visible ones, each a billboard (a textured quad facing the camera).

The opaque part is drawn first, the nearest tree first, so that the depth test hides what is behind;
the soft edges are blended after all else, the farthest first.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from simulator.arrays import FloatArray
from simulator.camera.core.context import Graphics
from simulator.camera.core.frustum_culling import visible_spheres
from simulator.camera.vegetation import foliage
from simulator.camera.vegetation.foliage import CORNERS
from simulator.camera.vegetation.scenery import Trees

Part = Literal["core", "fringe", "labels"]

REACH_M = 420.0
MOST = 160
"""Largest number of trees drawn at once; the farthest are left out."""
NEAR_M = 80.0
"""Trees nearer than this are drawn in two passes and within their outline; for farther trees, the
extra vertices would cost more than they save."""
_SQUARE = ((-0.5, 0.0), (0.5, 0.0), (0.5, 1.0), (-0.5, 1.0))
_SQUARE_FAN = np.array([[0, 1, 2], [0, 2, 3]])
_OUTLINE_FAN = 4 + np.array([[0, k, k + 1] for k in range(1, CORNERS - 1)])


@dataclass(frozen=True)
class VisibleTrees:
    """Indices of the corners of triangles (n, 3), the nearest tree's first; the first `near` of
    them are those of near trees."""

    corners: NDArray[np.uint32]
    near: int


class TreeMesh:
    """All trees of a scene."""

    def __init__(self, graphics: Graphics, trees: Trees, weather: str, *features: str) -> None:
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
        corners = context.buffer(vertices.tobytes() or bytes(4))
        self._indices = context.buffer(reserve=MOST * _OUTLINE_FAN.size * 4, dynamic=True)
        programs: dict[Part, str] = {
            "core": graphics.weather_program("tree", weather, "core", *features),
            "fringe": graphics.weather_program("tree", weather, *features),
            "labels": graphics.label_program("tree"),
        }
        self._arrays = {
            part: context.vertex_array(
                graphics.programs[program],
                [(corners, "3f 3f 3f 2f", "at", "shape", "tint", "corner")],
                index_buffer=self._indices,
                index_element_size=4,
                skip_errors=part == "labels",
            )
            for part, program in programs.items()
        }

    def visible(self, eye: FloatArray, planes: FloatArray, from_above: bool) -> VisibleTrees:
        """Frustum culling: the trees visible from `eye` (3,)."""
        trees = visible_spheres(self._feet, self._size, REACH_M, MOST, eye, planes)
        squared = ((self._feet[trees] - eye) ** 2).sum(axis=1)
        near = int(np.searchsorted(squared, NEAR_M**2))
        # Seen from above, a tree is drawn as a crown, which has another outline.
        fan = _SQUARE_FAN if from_above else _OUTLINE_FAN
        first = self._corners * trees[:, None, None]
        corners = np.concatenate(
            [(first[:near] + fan).reshape(-1, 3), (first[near:] + _SQUARE_FAN).reshape(-1, 3)]
        )
        return VisibleTrees(corners.astype(np.uint32), near * len(fan))

    def draw(self, seen: VisibleTrees, part: Part) -> None:
        """Draw the visible trees: the "core" of the near ones, then, blended over all else, the
        "fringe" and the far ones whole; or all of them at once as "labels"."""
        corners = seen.corners[: seen.near] if part == "core" else seen.corners
        if len(corners) == 0:
            return
        order = corners[::-1] if part == "fringe" else corners
        self._indices.orphan()
        self._indices.write(order.tobytes())
        self._arrays[part].render(vertices=order.size)
