"""The road as triangles: a ribbon of rows across the track, with (s, y) carried to every pixel.

World frame, metres; s along the centre line, y left positive. Rows lie close enough that the chord
between two of them leaves the true arc by less than `SAGITTA_M`, so what the shader paints at
(s, y) stands where the geometry says.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from simulator.camera.mesh import Chunks, Surface
from simulator.camera.terrain import CentreLine, Terrain
from simulator.track.road import Road

FloatArray = NDArray[np.float64]

SAGITTA_M = 0.0025
LONGEST_ROW_M = 4.0
TWIST_M = 0.004
"""Two triangles miss the twisted road plane between two rows by no more."""
SKIRT_M = 10.0
"""How far the ribbon reaches into the land beyond the wall."""
KERB_CURVATURE = 1.0 / 220.0
CHUNK_ROWS, COARSE_ROWS = 16, 4


@dataclass(frozen=True)
class Ribbon:
    """Places of the road: rows `s` (R,), lateral columns `y` (R, C) and points (R, C, 3)."""

    s: FloatArray
    y: FloatArray
    points: FloatArray
    curvature: FloatArray
    wall: tuple[int, int]
    """Columns of the left and the right wall line."""

    def ground(self, row: NDArray[np.intp], offset: FloatArray) -> FloatArray:
        """Height of the ribbon's surface at lateral `offset` of a row, by the nearest columns."""
        y, z = self.y[row], self.points[row, :, 2]
        column = np.clip(np.sum(y > offset[:, None], axis=1), 1, y.shape[1] - 1)
        pick = np.arange(len(row))
        y0, y1 = y[pick, column - 1], y[pick, column]
        share = np.clip((offset - y0) / np.minimum(y1 - y0, -1e-6), 0.0, 1.0)
        return np.asarray(z[pick, column - 1] + share * (z[pick, column] - z[pick, column - 1]))


def rows_of(road: Road) -> FloatArray:
    """Places s of the rows, from 0 to the track's length, both included."""
    track = road.track
    radius = 1.0 / np.maximum(np.abs(track.curvature0), 1e-9)
    step = np.sqrt(8.0 * radius * SAGITTA_M)
    twist = np.abs(track.z_left1 - track.z_right1 - track.z_left0 + track.z_right0)
    twist *= road.wall_offset / track.width / track.length
    step = np.minimum(step, 4.0 * TWIST_M / np.maximum(twist, 1e-9))
    step = np.clip(step, 0.3, LONGEST_ROW_M)
    parts = np.maximum(1, np.ceil(track.length / step)).astype(np.intp)
    start = np.repeat(track.s0, parts)
    size = np.repeat(track.length / parts, parts)
    number = np.arange(len(start)) - np.repeat(np.cumsum(parts) - parts, parts)
    return np.append(start + size * number, track.length_m)


def build(road: Road, line: CentreLine, terrain: Terrain) -> Ribbon:
    """Lay the ribbon and let its skirts run out into the land."""
    s = rows_of(road)
    pose = road.track.at(s)
    wall = road.wall_offset
    left = _skirt(road, line, s, pose.curvature, 1.0)
    right = _skirt(road, line, s, pose.curvature, -1.0)
    middle = np.array([wall, 0.0, -wall])
    y = np.empty((len(s), len(middle) + 4))
    y[:, 2:-2] = middle
    y[:, 0], y[:, 1] = wall + left, wall + 0.35 * left
    y[:, -1], y[:, -2] = -wall - right, -wall - 0.35 * right
    flat = road.track.at(s[:, None], y)
    points = np.stack([flat.x, flat.y, flat.z], axis=-1)
    for outer, between, edge in ((0, 1, 2), (-1, -2, -3)):
        land = terrain.height(points[:, outer, 0], points[:, outer, 1]) - 0.6
        points[:, outer, 2] = np.minimum(land, points[:, edge, 2] + 4.0)
        rise = points[:, outer, 2] - points[:, edge, 2]
        points[:, between, 2] = points[:, edge, 2] + 0.12 * rise - 0.05
    return Ribbon(s, y, points, pose.curvature, (2, y.shape[1] - 3))


def _skirt(
    road: Road, line: CentreLine, s: FloatArray, curvature: FloatArray, side: float
) -> FloatArray:
    """Width of the skirt on one side (+1 left): never over another part of the road."""
    width = np.full(len(s), 0.4)
    for share in (0.25, 0.5, 0.75, 1.0):
        offset = road.wall_offset + SKIRT_M * share
        pose = road.track.at(s, side * offset)
        clear = line.distance(pose.x, pose.y) > offset - 1.0
        # Beyond the centre of a bend the ribbon would fold over.
        clear &= curvature * side * offset < 0.85
        width = np.where(clear & (width >= SKIRT_M * (share - 0.25) - 0.1), SKIRT_M * share, width)
    # A width that jumps would tear the skirt's edge; the narrowest neighbour counts.
    for _ in range(2):
        width = np.minimum(width, np.minimum(np.roll(width, 1), np.roll(width, -1)))
    return width


def surface(ribbon: Ribbon, road: Road) -> Surface:
    """The ribbon's triangles; a vertex is x, y, z, s, y, normal (3), kerb."""
    rows, columns = ribbon.y.shape
    vertices = np.empty((rows, columns, 9), dtype=np.float32)
    vertices[..., 0:3] = ribbon.points
    vertices[..., 3] = ribbon.s[:, None]
    vertices[..., 4] = ribbon.y
    vertices[..., 5:8] = _normals(ribbon)
    vertices[..., 8] = _kerb(ribbon, road)[:, None]
    return strip(vertices, ribbon.points)


def _normals(ribbon: Ribbon) -> FloatArray:
    along = np.gradient(ribbon.points, axis=0)
    left, right = ribbon.points[:, 2:3], ribbon.points[:, -3:-2]
    across = np.broadcast_to(left - right, ribbon.points.shape).copy()
    across[:, :2] = ribbon.points[:, :1] - ribbon.points[:, 2:3]
    across[:, -2:] = ribbon.points[:, -3:-2] - ribbon.points[:, -1:]
    normal = np.cross(along, across)
    return np.asarray(normal / np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-9))


def _kerb(ribbon: Ribbon, road: Road) -> FloatArray:
    """1 where kerbs stand beside the asphalt, 0 elsewhere, with short ramps between."""
    bend = np.abs(ribbon.curvature) > KERB_CURVATURE
    kerb = bend.astype(np.float64) * float(road.track.markings.kerbs)
    for _ in range(2):
        kerb = np.maximum(kerb, 0.5 * (np.roll(kerb, 1) + np.roll(kerb, -1)))
    return kerb


def strip(vertices: NDArray[np.float32], points: FloatArray) -> Surface:
    """Triangles between the rows of a vertex grid (R, C, F), in two levels of detail: all rows,
    and one row in COARSE_ROWS; cut into chunks for culling."""
    rows, columns = vertices.shape[:2]
    starts = np.arange(0, rows - 1, CHUNK_ROWS)
    ends = np.minimum(starts + CHUNK_ROWS, rows - 1)
    every = np.arange(rows)
    some = np.unique(np.concatenate([every[::COARSE_ROWS], [rows - 1]]))
    indices = [_between(every, columns), _between(some, columns)]
    a_quad = (columns - 1) * 6
    first = [starts * a_quad, len(indices[0]) + np.searchsorted(some, starts) * a_quad]
    count = [(ends - starts), np.searchsorted(some, ends) - np.searchsorted(some, starts)]
    low = np.minimum.reduceat(points.min(axis=1), starts, axis=0)
    high = np.maximum.reduceat(points.max(axis=1), starts, axis=0)
    low = np.minimum(low, points[ends].min(axis=1))
    high = np.maximum(high, points[ends].max(axis=1))
    return Surface(
        np.ascontiguousarray(vertices.reshape(rows * columns, -1)),
        np.concatenate(indices),
        Chunks(
            (low + high) / 2.0,
            np.linalg.norm(high - low, axis=1) / 2.0,
            np.stack(first).astype(np.int64),
            np.stack(count).astype(np.int64) * a_quad,
        ),
    )


def _between(rows: NDArray[np.intp], columns: int) -> NDArray[np.uint32]:
    """Indices of two triangles for each cell between consecutive `rows` of a grid."""
    near, far = columns * rows[:-1, None], columns * rows[1:, None]
    cell = np.arange(columns - 1)
    corners = [
        near + cell,
        far + cell,
        near + cell + 1,
        near + cell + 1,
        far + cell,
        far + cell + 1,
    ]
    return np.stack(corners, axis=-1).reshape(-1).astype(np.uint32)
