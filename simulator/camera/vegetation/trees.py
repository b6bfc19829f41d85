"""Draws the nearest visible trees, each as a billboard (a textured quad that faces the camera).

The opaque parts are drawn first, the nearest tree first, so that the depth test skips what near
trees hide. The soft edges are blended after everything else, the farthest tree first.
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
"""Largest number of trees drawn at once; trees farther away are left out."""
NEAR_M = 80.0
"""Distance (m) up to which trees are drawn in two passes and within their outline. For farther
trees the additional vertices would cost more time than they save."""
_SQUARE = ((-0.5, 0.0), (0.5, 0.0), (0.5, 1.0), (-0.5, 1.0))
_SQUARE_FAN = np.array([[0, 1, 2], [0, 2, 3]])
_OUTLINE_FAN = 4 + np.array([[0, k, k + 1] for k in range(1, CORNERS - 1)])


@dataclass(frozen=True)
class VisibleTrees:
    """Corner indices (n, 3) of the triangles of the visible trees, nearest tree first. The first
    `near` triangles belong to trees within 80 m of the eye."""

    corners: NDArray[np.uint32]
    near: int


class TreeMesh:
    """All trees of a scene in graphics memory."""

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
        """Return the visible trees, at most the 160 nearest within 420 m of `eye` (3,), m, world.
        `planes` (4, 3) are the inward normals of the side planes. `from_above` is True for a view
        straight down, in which the trees are drawn as crowns."""
        trees = visible_spheres(self._feet, self._size, REACH_M, MOST, eye, planes)
        squared = ((self._feet[trees] - eye) ** 2).sum(axis=1)
        near = int(np.searchsorted(squared, NEAR_M**2))
        # Trees seen from above are drawn as crowns, which do not have the outline of their kind.
        fan = _SQUARE_FAN if from_above else _OUTLINE_FAN
        first = self._corners * trees[:, None, None]
        corners = np.concatenate(
            [(first[:near] + fan).reshape(-1, 3), (first[near:] + _SQUARE_FAN).reshape(-1, 3)]
        )
        return VisibleTrees(corners.astype(np.uint32), near * len(fan))

    def draw(self, seen: VisibleTrees, part: Part) -> None:
        """Draw one part of the visible trees. "core" is the opaque part of near trees. "fringe" is
        the edges of near trees and the whole of far trees, blended over everything drawn before.
        "labels" is depth and class of all trees."""
        corners = seen.corners[: seen.near] if part == "core" else seen.corners
        if len(corners) == 0:
            return
        order = corners[::-1] if part == "fringe" else corners
        self._indices.orphan()
        self._indices.write(order.tobytes())
        self._arrays[part].render(vertices=order.size)
