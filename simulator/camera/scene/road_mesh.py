"""The triangle mesh of the road: rows of vertices across the track, each vertex with its (s, y).

World frame, metres; s along the centre line, y left positive. Rows are so close that the chord
between two rows deviates from the true arc by less than 2.5 mm. So the paint that the shader draws
at (s, y) lies where the track geometry has that point.
"""

from dataclasses import dataclass
from itertools import pairwise
from typing import Self

import numpy as np
from numpy.typing import NDArray

from simulator.arrays import FloatArray
from simulator.camera.core.mesh import Surface
from simulator.camera.scene.strips import LEVELS, Level, strip
from simulator.camera.scene.terrain import CentreLineSamples, Survey, Terrain
from simulator.track.road import BRIDGE_M, Road

LAYOUT = ("3f 2f 3f 1f", "at", "road", "facing", "kerbed")
"""Layout of a vertex: x, y, z, s, lateral offset, normal (3), kerb (0 to 1)."""
SAGITTA_M = 0.0025
LONGEST_ROW_M = 4.0
TWIST_M = 0.004
"""Largest deviation (m) of two triangles from the twisted road plane between two rows."""
SKIRT_M = 10.0
"""Largest width of a skirt, the part of the mesh between wall line and terrain."""
DECK_M, CLEAR_M = 1.0, 1.5
"""Where the road is a bridge over a lower part of itself, the skirt ends DECK_M below the wall
line. This part of the skirt is over the asphalt of the lower road and over CLEAR_M beside it. Both
in m."""
KERB_CURVATURE = 1.0 / 220.0
SKIRT_WEIGHT, KERB_WEIGHT = 0.05, 0.3
"""Weights of geometric errors on the skirt and the kerb, relative to errors on the road."""
_ASPHALT = ((3, 4),)
_LEFT, _RIGHT = ((0, 1), (1, 2), (2, 3)), ((4, 5), (5, 6), (6, 7))
_FAR = ((0, 2), (2, 3), (4, 5), (5, 7))
VERGE = (Level(30.0, 0.04, 12.0), Level(90.0, 0.1, 24.0), Level(300.0, 0.3, 48.0))
"""Levels of detail of the verge, coarser than the levels of the asphalt."""
LAP_M, LAP_DOWN_M, RISE_WEIGHT = 0.3, 0.06, 4.0
"""Overlap of the verge below the asphalt (m), the verge's depth there (m), and the weight of errors
of the verge's height. The weight keeps the verge below the asphalt at every level of detail."""


@dataclass(frozen=True)
class RoadMesh:
    """Vertices of the road in R rows and C columns. `s` (R,), m, are the positions of the rows
    along the road, `y` (R, C), m, the lateral offsets of the vertices, from left to right, and
    `points` (R, C, 3), m, the positions in the world. `curvature` (R,) is in 1/m."""

    s: FloatArray
    y: FloatArray
    points: FloatArray
    curvature: FloatArray
    wall: tuple[int, int]
    """Indices of the columns of the left and the right wall line."""
    bridge: NDArray[np.bool_]
    """Mask (R,) of the rows in which the road is a bridge over a lower part of itself."""

    def deck_edges(self) -> FloatArray:
        """Return the lower edges (R, 2, 3), m, left and right, that a bridge's deck has."""
        edges = self.points[:, [0, -1]]
        edges[..., 2] = self.points[:, list(self.wall), 2] - DECK_M
        return edges

    def ground(self, row: NDArray[np.intp], offset: FloatArray) -> FloatArray:
        """Return the height (n,) m of the mesh in the rows `row` (n,) at lateral `offset` (n,) m,
        interpolated between the nearest columns."""
        y, z = self.y[row], self.points[row, :, 2]
        column = np.clip(np.sum(y > offset[:, None], axis=1), 1, y.shape[1] - 1)
        pick = np.arange(len(row))
        y0, y1 = y[pick, column - 1], y[pick, column]
        share = np.clip((offset - y0) / np.minimum(y1 - y0, -1e-6), 0.0, 1.0)
        return np.asarray(z[pick, column - 1] + share * (z[pick, column] - z[pick, column - 1]))


def rows_of(road: Road) -> FloatArray:
    """Return the positions s (R,) m of the rows, from 0 to the track's length, both included."""
    track = road.track
    radius = 1.0 / np.maximum(np.abs(track.curvature0), 1e-9)
    step = np.sqrt(8.0 * radius * SAGITTA_M)
    twist = np.abs(track.z_left1 - track.z_right1 - track.z_left0 + track.z_right0)
    widest = max(2.0 * road.half_asphalt, road.wall_offset - road.half_asphalt)
    twist *= widest / track.width / track.length
    step = np.minimum(step, 4.0 * TWIST_M / np.maximum(twist, 1e-9))
    step = np.clip(step, 0.3, LONGEST_ROW_M)
    parts = np.maximum(1, np.ceil(track.length / step)).astype(np.intp)
    start = np.repeat(track.s0, parts)
    size = np.repeat(track.length / parts, parts)
    number = np.arange(len(start)) - np.repeat(np.cumsum(parts) - parts, parts)
    return np.append(start + size * number, track.length_m)


def build(road: Road, line: CentreLineSamples, terrain: Terrain) -> RoadMesh:
    """Build the mesh of `road`, with skirts that end below `terrain`. `line` are the samples of the
    road's centre line."""
    s = rows_of(road)
    pose = road.track.at(s)
    wall = road.wall_offset
    left = _skirt(road, line, s, pose.curvature, 1.0)
    right = _skirt(road, line, s, pose.curvature, -1.0)
    ends = road.asphalt
    middle = np.array([wall, ends[0], -ends[1], -wall])
    y = np.empty((len(s), len(middle) + 4))
    y[:, 2:-2] = middle
    y[:, 0], y[:, 1] = wall + left, wall + 0.35 * left
    y[:, -1], y[:, -2] = -wall - right, -wall - 0.35 * right
    flat = road.track.at(s[:, None], y)
    points = np.stack([flat.x, flat.y, flat.z], axis=-1)
    bridge = np.zeros(len(s), dtype=np.bool_)
    for outer, between, edge in ((0, 1, 2), (-1, -2, -3)):
        land = terrain.height(points[:, outer, 0], points[:, outer, 1]) - 0.6
        over = _over_road(road, line, y[:, outer], points[:, outer, :2], points[:, edge, 2])
        land = np.where(over, np.maximum(land, points[:, edge, 2] - DECK_M), land)
        bridge |= over
        points[:, outer, 2] = np.minimum(land, points[:, edge, 2] + 4.0)
        rise = points[:, outer, 2] - points[:, edge, 2]
        points[:, between, 2] = points[:, edge, 2] + 0.12 * rise - 0.05
    # A bridge that crosses askew is over the lower road first with one side, then with the other.
    rows = np.flatnonzero(bridge)
    for first, then in pairwise(rows):
        bridge[first:then] |= s[then] - s[first] < 4.0 * wall
    return RoadMesh(s, y, points, pose.curvature, (2, y.shape[1] - 3), bridge)


def _skirt(
    road: Road, line: CentreLineSamples, s: FloatArray, curvature: FloatArray, side: float
) -> FloatArray:
    """Return the width (R,) m of the skirt on one side (1 left, -1 right) at the rows `s` (R,) m.
    It is limited so that the skirt overlaps no part of the road. `line` are the samples of the
    centre line, `curvature` (R,) is its curvature (1/m) at the rows."""
    width = np.full(len(s), 0.4)
    for share in (0.25, 0.5, 0.75, 1.0):
        offset = road.wall_offset + SKIRT_M * share
        pose = road.track.at(s, side * offset)
        clear = line.distance(pose.x, pose.y) > offset - 1.0
        # Beyond the centre of a bend the mesh would fold over.
        clear &= curvature * side * offset < 0.85
        width = np.where(clear & (width >= SKIRT_M * (share - 0.25) - 0.1), SKIRT_M * share, width)
    # A jump of the width would leave gaps at the edge, so the narrowest neighbour is used.
    for _ in range(2):
        width = np.minimum(width, np.minimum(np.roll(width, 1), np.roll(width, -1)))
    return width


def _over_road(
    road: Road, line: CentreLineSamples, offset: FloatArray, at: FloatArray, height: FloatArray
) -> NDArray[np.bool_]:
    """Return a mask (R,) of the rows whose outer points `at` (R, 2), m, are over the asphalt of a
    lower part of the road, and of the rows next to them. `offset` (R,), m, is the lateral offset of
    the points, `height` (R,), m, the height of the wall line in these rows."""
    near, sample = line.tree.query(at)
    under = near < np.minimum(np.abs(offset) - 1.0, road.half_asphalt + CLEAR_M)
    under[under] = road.track.at(line.s[sample[under]]).z < height[under] - BRIDGE_M
    return np.asarray(under | np.roll(under, 1) | np.roll(under, -1))


def covers(mesh: RoadMesh, survey: Survey, margin_m: float) -> NDArray[np.bool_]:
    """Return a mask (rows, columns) of the grid points of `survey` that lie more than `margin_m`
    (m) inside the outer edges of `mesh`, but not below a bridge of the road."""
    row = np.clip(np.searchsorted(mesh.s, survey.line.s), 1, len(mesh.s) - 1)[survey.sample]
    reach = np.minimum(mesh.y[:, 0], -mesh.y[:, -1])
    inside = survey.near < np.minimum(reach[row - 1], reach[row]) - margin_m
    return np.asarray(inside & ~mesh.bridge[row])


def surfaces(mesh: RoadMesh, road: Road) -> dict[str, Surface]:
    """Build the surfaces "paved" (asphalt) and "verge", named after the programs that draw them."""
    rows, columns = mesh.y.shape
    vertices = np.empty((rows, columns, 9), dtype=np.float32)
    vertices[..., 0:3] = mesh.points
    vertices[..., 3] = mesh.s[:, None]
    vertices[..., 4] = mesh.y
    vertices[..., 5:8] = _normals(mesh)
    vertices[..., 8] = _kerb(mesh, road)[:, None]
    kerb = vertices[:, 0, 8]
    profile = np.column_stack([mesh.points[:, 2:-2].reshape(rows, -1), KERB_WEIGHT * kerb])
    asphalt = strip(vertices, mesh.points, mesh.s, profile, [_ASPHALT] * len(LEVELS))
    weight = np.tile([1.0, 1.0, RISE_WEIGHT], (columns, 1))
    weight[[0, 1, -2, -1]] = SKIRT_WEIGHT
    places = (mesh.points * weight).reshape(rows, -1)
    profile = np.column_stack([places, KERB_WEIGHT * kerb])
    cells = [(*_LEFT, *_RIGHT), _FAR, _FAR]
    beside = strip(_lapped(vertices), mesh.points, mesh.s, profile, cells, VERGE)
    return {"paved": asphalt, "verge": beside}


def _lapped(vertices: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the vertices with the inner edges of the verge moved below the asphalt, so that no gap
    opens between different levels of detail."""
    vertices = vertices.copy()
    for inner, outer in ((3, 2), (4, 5)):
        step = np.sign(vertices[:, inner, 4] - vertices[:, outer, 4])[:, None] * LAP_M
        across = vertices[:, inner, :5] - vertices[:, outer, :5]
        vertices[:, inner, :5] += across / across[:, 4:] * step
        vertices[:, inner, 2] -= LAP_DOWN_M
    return vertices


def _normals(mesh: RoadMesh) -> FloatArray:
    """Return the unit normals (R, C, 3) at the vertices."""
    along = np.gradient(mesh.points, axis=0)
    left, right = mesh.points[:, 2:3], mesh.points[:, -3:-2]
    across = np.broadcast_to(left - right, mesh.points.shape).copy()
    across[:, :2] = mesh.points[:, :1] - mesh.points[:, 2:3]
    across[:, -2:] = mesh.points[:, -3:-2] - mesh.points[:, -1:]
    normal = np.cross(along, across)
    return np.asarray(normal / np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-9))


def _kerb(mesh: RoadMesh, road: Road) -> FloatArray:
    """Return the kerb (R,): 1 in rows with kerbs, 0 elsewhere, with short ramps between."""
    bend = np.abs(mesh.curvature) > KERB_CURVATURE
    kerb = bend.astype(np.float64) * float(road.track.markings.kerbs)
    for _ in range(2):
        kerb = np.maximum(kerb, 0.5 * (np.roll(kerb, 1) + np.roll(kerb, -1)))
    return kerb


@dataclass(frozen=True)
class Ground:
    """The ground of a scene: the road with its centre line and mesh, and the terrain."""

    road: Road
    line: CentreLineSamples
    mesh: RoadMesh
    terrain: Terrain

    @classmethod
    def of(cls, road: Road, line: CentreLineSamples, terrain: Terrain) -> Self:
        """Build the road mesh and return the ground of `road`."""
        return cls(road, line, build(road, line, terrain), terrain)

    def place_beside(
        self, s: FloatArray, offset: FloatArray, clear_m: float | FloatArray
    ) -> tuple[NDArray[np.bool_], FloatArray, FloatArray]:
        """Return a mask of the points (`s`, `offset`), m, that lie more than `clear_m` (m) outside
        the wall lines of every part of the track, and x, y (m, world) of all points. All arrays
        have one shape. The wall lines are where the barriers stand."""
        pose = self.road.track.at(s, offset)
        near = self.line.distance(pose.x, pose.y)
        free = near > self.road.wall_offset + clear_m
        return free, pose.x, pose.y

    def is_clear(self, points: FloatArray, clear_m: float) -> bool:
        """Return whether all points (n, 2), m, world, lie more than `clear_m` (m) outside the wall
        lines of every part of the track."""
        near = self.line.distance(points[:, 0], points[:, 1])
        return bool((near > self.road.wall_offset + clear_m).all())

    def height(self, s: FloatArray, offset: FloatArray, x: FloatArray, y: FloatArray) -> FloatArray:
        """Return the visible height (n,), m, at points with the track coordinates `s`, `offset` and
        the world coordinates `x`, `y`, each (n,), m. It is the height of the terrain, or of the
        road mesh's skirt where the skirt is higher."""
        mesh = self.mesh
        row = np.clip(np.searchsorted(mesh.s, s), 0, len(mesh.s) - 1)
        skirt = mesh.ground(row, offset)
        on_skirt = (offset < mesh.y[row, 0]) & (offset > mesh.y[row, -1])
        land = self.terrain.height(x, y)
        return np.where(on_skirt, np.maximum(land, skirt), land)
