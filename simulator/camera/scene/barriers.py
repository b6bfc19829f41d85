"""Builds the barriers on both sides of the road, such as rails, walls and hedges. The kind of
barrier changes from section to section.

World frame, metres. The collision shapes of the walls are in `simulator.world.walls`.
"""

import numpy as np
from numpy.typing import NDArray

from simulator.arrays import FloatArray
from simulator.camera.core.mesh import Surface
from simulator.camera.scene.road_mesh import RoadMesh
from simulator.camera.scene.strips import Level, strip
from simulator.camera.scene.themes import Theme
from simulator.track.road import Road
from simulator.varied.look import Roadside

KINDS: tuple[str, ...] = (
    "rail", "wall", "hedge", "fence", "stones", "tyres", "crops", "bank", "none",
)  # fmt: skip
"""Kinds of barriers; their order is the numbering in barrier.frag.glsl."""
HEIGHT_M = np.array([0.8, 0.9, 1.25, 1.05, 0.75, 0.95, 1.1, 0.6, 0.0])
THICK_M = np.array([0.06, 0.25, 0.9, 0.06, 0.5, 0.7, 3.0, 0.8, 0.0])
GROWS = np.isin(KINDS, ("wall", "crops", "bank"))
"""Mask of the kinds whose height the look of a varied road scales."""
SECTION_M = (90.0, 420.0)
LAYOUT = ("3f 2f 1f 3f", "at", "along", "kind", "facing")
"""Layout of a vertex: x, y, z, s, height, kind, normal (3)."""
LEVELS = (Level(35.0, 0.005, 16.0), Level(120.0, 0.03, 32.0), Level(300.0, 0.1, 64.0))


def build(
    road: Road, mesh: RoadMesh, theme: Theme, rng: np.random.Generator, roadside: Roadside
) -> Surface:
    """Build the barriers of both sides as one surface. Each section has a random kind out of
    `theme.barriers`. On a side for which `roadside` names a kind, all sections have that kind."""
    grids, profiles = [], []
    heights = np.where(GROWS, roadside.height, 1.0) * HEIGHT_M
    for side, column, only in zip(
        (1.0, -1.0), mesh.wall, (roadside.left, roadside.right), strict=True
    ):
        kinds = (only,) if only else theme.barriers
        kind = _sections(mesh.s, road.track.length_m, kinds, rng)
        grid = _one_side(mesh, road, side, column, (kind, heights[kind]))
        grids.append(grid)
        # The large weight makes `strip` keep every row at which the kind changes.
        profiles.append(np.column_stack([mesh.points[:, column], 100.0 * kind]))
    # One strip contains both sides; the quads between left and right side have no area.
    left, right = grids
    bridge = np.stack([left[-1], right[0]])
    bridge[0, :, :3], bridge[1, :, :3] = left[-1, 0, :3], right[0, 0, :3]
    vertices = np.concatenate([left, bridge, right])
    ends = np.stack([profiles[0][-1], profiles[1][0]]) + 1e6
    length = mesh.s[-1]
    return strip(
        vertices,
        vertices[..., :3].astype(np.float64),
        np.concatenate([mesh.s, [length + 1.0, length + 2.0], length + 3.0 + mesh.s]),
        np.concatenate([profiles[0], ends, profiles[1]]),
        [((0, 1), (1, 2))] * len(LEVELS),
        LEVELS,
    )


def _sections(
    s: FloatArray, length: float, kinds: tuple[str, ...], rng: np.random.Generator
) -> NDArray[np.intp]:
    """Return the kind (R,) of barrier at each row of the road mesh, as indices into KINDS. The rows
    are at `s` (R,), m, on a track of `length` m. Each section has a random kind out of `kinds`."""
    count = int(length / SECTION_M[0]) + 2
    ends = np.cumsum(rng.uniform(*SECTION_M, count))
    choice = rng.choice(np.array([KINDS.index(kind) for kind in kinds]), count)
    return np.asarray(choice[np.searchsorted(ends, np.minimum(s, ends[-2]))], dtype=np.intp)


def _one_side(
    mesh: RoadMesh,
    road: Road,
    side: float,
    column: int,
    build: tuple[NDArray[np.intp], FloatArray],
) -> NDArray[np.float32]:
    """Return the vertices (R, 3, 9) of one side (`side` 1 left, -1 right): foot, upper edge, and
    far edge of the top. `build` contains the kind (R,) of the barrier and its height (R,) in m;
    `column` is the wall line's column of the mesh."""
    kind, height = build
    foot = mesh.points[:, column].copy()
    heading = road.track.at(mesh.s).heading
    outwards = side * np.stack([-np.sin(heading), np.cos(heading), np.zeros_like(heading)], axis=1)
    thick = THICK_M[kind]
    up = np.array([0.0, 0.0, 1.0])
    edge = foot + height[:, None] * up
    far = edge + thick[:, None] * outwards
    grid = np.empty((len(foot), 3, 9), dtype=np.float32)
    grid[:, 0, :3] = foot - 0.25 * up
    grid[:, 1, :3], grid[:, 2, :3] = edge, far
    grid[..., 3] = mesh.s[:, None]
    grid[:, 0, 4], grid[:, 1, 4], grid[:, 2, 4] = -0.25, height, height + thick
    grid[..., 5] = kind[:, None]
    grid[..., 6:9] = -outwards[:, None]
    return grid
