"""Builds triangle meshes of the terrain, fine near the viewer and coarse up to the horizon, and
computes the share of sunlight that trees block from it. World frame, metres."""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from simulator.arrays import FloatArray
from simulator.camera.core.mesh import Chunks, Surface
from simulator.camera.scene.light import Light
from simulator.camera.scene.terrain import CentreLineSamples, Terrain, between
from simulator.camera.vegetation.scenery import Trees

LAYOUT = ("3f 3f 1f", "at", "facing", "sunlit")
"""Layout of a vertex: x, y, z, normal (3), share of sunlight that arrives."""
BLOCK = 4
"""Cells along each side of a chunk."""
SMOOTH_M = 9.0
MOST_SHADE = 0.8
CANOPY, CANOPY_M = 0.55, 30.0
"""Shade of the canopy in the light "heavy-shadow" (0 to 1), and a distance from the centre line.
The shade is full up to half this distance, halved at this distance, and 0 from 1.5 times this
distance on."""


@dataclass(frozen=True)
class TreeShade:
    """The share of sunlight that trees block from the terrain, 0 to 0.8: `shade` (rows along y,
    columns along x) at the grid points of `terrain`. It is smoothed, so single shadows are not
    resolved."""

    terrain: Terrain
    shade: FloatArray

    @classmethod
    def of(
        cls, terrain: Terrain, line: CentreLineSamples, trees: Trees, light: Light
    ) -> "TreeShade":
        """Compute the shade of `trees` in `light`; it is zero if the sun casts no hard shadow."""
        shade: FloatArray = np.zeros(terrain.z.shape)
        if light.shade >= 0.5:
            return cls(terrain, shade)
        sx, sy, sz = light.sun_direction
        run = np.minimum(trees.height * np.hypot(sx, sy) / max(sz, 0.1), 40.0)
        area = 0.6 * trees.width * np.maximum(run, trees.width)
        grid, feet = terrain.grid, trees.feet
        i, j, inside = grid.nearest(feet[:, 0] - 0.5 * run * sx, feet[:, 1] - 0.5 * run * sy)
        np.add.at(shade, (j[inside], i[inside]), area[inside] / grid.cell**2)
        shade = np.asarray(cv2.GaussianBlur(shade, (0, 0), SMOOTH_M / grid.cell), np.float64)
        if light.canopy:
            near = line.distance(*np.meshgrid(*grid.axes))
            shade = np.maximum(shade, CANOPY * np.clip(1.5 - near / CANOPY_M, 0.0, 1.0))
        return cls(terrain, MOST_SHADE * (1.0 - np.exp(-shade / MOST_SHADE)))

    def at(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """Return the share of sunlight, 0 to 0.8, that trees block at the world points x, y (m,
        arrays of one shape). It is the value of the nearest grid point."""
        i, j, _ = self.terrain.grid.nearest(x, y)
        rows, columns = self.shade.shape
        return np.asarray(self.shade[np.clip(j, 0, rows - 1), np.clip(i, 0, columns - 1)])


@dataclass(frozen=True)
class Span:
    """A level of detail of the terrain, drawn from `start_m` to `reach_m` (m) from the eye. A cell
    of this level covers `step` x `step` cells of the finest grid. `bare` is whether cells below the
    road mesh are drawn."""

    step: int
    start_m: float
    reach_m: float
    bare: bool


def surface(land: TreeShade, hidden: NDArray[np.bool_], span: Span) -> Surface:
    """Build the mesh of the terrain of `land` at the level of detail `span`. This mesh is nowhere
    higher than the mesh of the finest level.

    `hidden` (rows, columns) marks the points of the finest grid that the road mesh covers.
    """
    terrain, every = land.terrain, (slice(None, None, span.step),) * 2
    z, normals = lowered(terrain.z, span.step), terrain.normals()[every]
    rows, columns = z.shape
    vertices = np.empty((rows, columns, 7), dtype=np.float32)
    grid = terrain.grid
    vertices[..., 0] = grid.x0 + grid.cell * span.step * np.arange(columns)
    vertices[..., 1] = (grid.y0 + grid.cell * span.step * np.arange(rows))[:, None]
    vertices[..., 2] = z
    vertices[..., 3:6] = normals
    vertices[..., 6] = 0.9 * (1.0 - land.shade[every])
    shown = np.ones((rows - 1, columns - 1), dtype=np.bool_)
    if not span.bare:
        window = np.ones((span.step + 1,) * 2, np.uint8)
        covered = cv2.erode(hidden.astype(np.uint8), window, anchor=(0, 0))
        shown = covered[every][:-1, :-1] == 0
    return _in_chunks(vertices, shown, span)


def lowered(z: FloatArray, step: int) -> FloatArray:
    """Return the heights (m) of a coarse grid: every `step`-th height of `z` (rows, columns), m, in
    both directions. Each is lowered so far that no coarse triangle rises above the fine heights."""
    kept = z[::step, ::step]
    if step == 1:
        return kept
    share = np.arange(z.shape[0]) / step, np.arange(z.shape[1]) / step
    over = np.maximum(between(kept, share[1][None, :], share[0][:, None]) - z, 0.0)
    reach = np.ones((2 * step - 1, 2 * step - 1), np.uint8)
    return np.asarray(kept - cv2.dilate(over, reach)[::step, ::step], dtype=np.float64)


def _in_chunks(vertices: NDArray[np.float32], shown: NDArray[np.bool_], span: Span) -> Surface:
    """Build two triangles for each cell of the grid of `vertices` that is `shown`, in chunks of
    BLOCK x BLOCK cells. `span` is the level of detail."""
    columns = vertices.shape[1]
    j, i = np.nonzero(shown)
    block = (j // BLOCK) * (columns // BLOCK + 1) + i // BLOCK
    order = np.argsort(block, kind="stable")
    corner = (j * columns + i)[order]
    _, first, cells = np.unique(block[order], return_index=True, return_counts=True)
    base = np.array([0, 1, columns, 1, columns + 1, columns])
    indices = (corner[:, None] + base).astype(np.uint32)
    places = vertices.reshape(-1, 7)[:, :3].astype(np.float64)[indices]
    low = np.minimum.reduceat(places.min(axis=1), first, axis=0)
    high = np.maximum.reduceat(places.max(axis=1), first, axis=0)
    chunks = Chunks(
        low,
        high,
        6 * first[None].astype(np.int64),
        6 * cells[None].astype(np.int64),
        (span.reach_m,),
        span.start_m,
    )
    return Surface(vertices.reshape(-1, 7), indices.reshape(-1), chunks)
