"""The terrain round a track: a height grid with hills that stays below the road.

World frame, metres. Near the road the grid is lowered, so that it never pierces the asphalt. The
skirts of the road mesh (`road_mesh`) cover the gap.
"""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import cv2
import numpy as np
from numpy.typing import NDArray

from simulator.arrays import FloatArray
from simulator.camera.scene.themes import Theme
from simulator.track.road import Road

if TYPE_CHECKING:
    from scipy.spatial import cKDTree


CELL_M = 8.0
COARSEST = 8
"""Step of the coarsest terrain mesh, in cells; the number of cells is a multiple of it."""
MARGIN_M = 400.0
MAX_CELLS = 1200
SAMPLE_M = 2.0
SINK_M = 0.9
SEA_BELOW_M = 3.0
"""Depth of the sea level below the lowest point of the road."""
SHORE_M = (14.0, 75.0)
"""Distances from the wall line between which the terrain descends to the sea."""
BANK_SLOPE = 0.55
"""Largest slope of the terrain at the roadside, m/m."""


@dataclass(frozen=True)
class CentreLineSamples:
    """Samples of a road's centre line about every 2 m: `s`, `x`, `y` in m and `heading` in rad,
    each (n,), and a k-d tree of x, y to find the nearest sample."""

    s: FloatArray
    x: FloatArray
    y: FloatArray
    heading: FloatArray
    tree: "cKDTree"

    @classmethod
    def of(cls, road: Road) -> "CentreLineSamples":
        """Sample the centre line of `road`."""
        length = road.track.length_m
        s = np.arange(0.0, length, length / max(8, round(length / SAMPLE_M)))
        pose = road.track.at(s)
        from scipy.spatial import (
            cKDTree,  # importing it takes 0.2 s; callers that only check a light do not need it
        )

        tree = cKDTree(np.stack([pose.x, pose.y], axis=1))
        return cls(s, pose.x, pose.y, pose.heading, tree)

    def distance(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """Return the distance (m) from each point x, y (m, world) to the nearest sample."""
        near, _ = self.tree.query(np.stack([x, y], axis=-1))
        return np.asarray(near, dtype=np.float64)


@dataclass(frozen=True)
class Grid:
    """A square grid from (x0, y0), spacing `cell` m; `shape` is (rows along y, columns along x)."""

    x0: float
    y0: float
    cell: float
    shape: tuple[int, int]

    @property
    def axes(self) -> tuple[FloatArray, FloatArray]:
        """x (m) of the columns and y (m) of the rows."""
        rows, columns = self.shape
        x, y = np.arange(columns, dtype=np.float64), np.arange(rows, dtype=np.float64)
        return self.x0 + self.cell * x, self.y0 + self.cell * y

    def nearest(
        self, x: FloatArray, y: FloatArray
    ) -> tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.bool_]]:
        """Return column and row of the grid point nearest to each point x, y (m, world), and
        whether it is inside the grid."""
        i = np.rint((x - self.x0) / self.cell).astype(np.intp)
        j = np.rint((y - self.y0) / self.cell).astype(np.intp)
        return i, j, (i >= 0) & (j >= 0) & (i < self.shape[1]) & (j < self.shape[0])


@dataclass(frozen=True)
class Survey:
    """Inputs of the terrain that depend only on the road, computed once for all scenes of a road.

    For each grid point: the greatest height that does not cover the road (`cap`), the smoothed
    height of the nearest road (`base`), the distance to the centre line (`near`), all in m, and the
    index of the nearest sample of the centre line (`sample`).
    """

    line: CentreLineSamples
    grid: Grid
    cap: FloatArray
    base: FloatArray
    near: FloatArray
    sample: NDArray[np.int64]

    @classmethod
    def of(cls, road: Road) -> "Survey":
        """Compute the survey of `road`."""
        line = CentreLineSamples.of(road)
        span = max(np.ptp(line.x), np.ptp(line.y)) + 2 * MARGIN_M
        cell = max(CELL_M, span / MAX_CELLS)
        x0, y0 = line.x.min() - MARGIN_M, line.y.min() - MARGIN_M
        columns = COARSEST * int(np.ceil((np.ptp(line.x) + 2 * MARGIN_M) / cell / COARSEST)) + 1
        rows = COARSEST * int(np.ceil((np.ptp(line.y) + 2 * MARGIN_M) / cell / COARSEST)) + 1
        grid = Grid(float(x0), float(y0), float(cell), (rows, columns))
        return cls(line, grid, _road_cap(road, line, grid), *_spread(road, line, grid))


@dataclass(frozen=True)
class Terrain:
    """Heights `z` (rows along y, columns along x) in m on a grid."""

    grid: Grid
    z: FloatArray
    sea: float = -np.inf
    """Height of the sea level; -inf if there is no sea."""

    def height(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """Return the height (m) at the world points x, y (m, arrays of one shape), interpolated on
        the triangles that are drawn."""
        grid = self.grid
        return between(self.z, (x - grid.x0) / grid.cell, (y - grid.y0) / grid.cell)

    def normals(self) -> FloatArray:
        """Return the unit normals (rows, columns, 3) at the grid points."""
        slope_y, slope_x = np.gradient(self.z, self.grid.cell)
        normal = np.stack([-slope_x, -slope_y, np.ones_like(self.z)], axis=-1)
        return np.asarray(normal / np.linalg.norm(normal, axis=-1, keepdims=True))


def between(z: FloatArray, u: FloatArray, v: FloatArray) -> FloatArray:
    """Return the heights (m) at the columns `u` and rows `v`, which may be fractions, of the grid
    `z` (rows, columns), m, interpolated on the drawn triangles. The result has the shape to which
    `u` and `v` broadcast."""
    rows, columns = z.shape
    u, v = np.clip(u, 0.0, columns - 1.001), np.clip(v, 0.0, rows - 1.001)
    i, j = u.astype(np.intp), v.astype(np.intp)
    fu, fv = u - i, v - j
    z00, z10 = z[j, i], z[j, i + 1]
    z01, z11 = z[j + 1, i], z[j + 1, i + 1]
    # The cell's diagonal runs from (1, 0) to (0, 1).
    low = z00 + (z10 - z00) * fu + (z01 - z00) * fv
    high = z11 + (z01 - z11) * (1.0 - fu) + (z10 - z11) * (1.0 - fv)
    return np.where(fu + fv <= 1.0, low, high)


def build(road: Road, survey: Survey, theme: Theme, rng: np.random.Generator) -> Terrain:
    """Build the terrain round `road` in the style of `theme`, from the road's `survey`."""
    line, grid, near, base = survey.line, survey.grid, survey.near, survey.base
    rolling = _rolling(grid, rng) * theme.hills_m
    away = np.clip((near - road.wall_offset - 5.0) / 110.0, 0.0, 1.0)
    natural = base + rolling * away * away * (3.0 - 2.0 * away)
    if not theme.sea:
        return Terrain(grid, np.minimum(natural, survey.cap))
    sea = float(road.track.at(line.s).z.min()) - SEA_BELOW_M
    fall = np.clip((near - road.wall_offset - SHORE_M[0]) / (SHORE_M[1] - SHORE_M[0]), 0.0, 1.0)
    fall *= fall * (3.0 - 2.0 * fall) * _outside(line, grid)
    natural += (sea - 4.0 - natural) * fall
    return Terrain(grid, np.maximum(np.minimum(natural, survey.cap), sea), sea)


def _road_cap(road: Road, line: CentreLineSamples, grid: Grid) -> FloatArray:
    """Return for each point of `grid` the greatest height (m) at which the terrain covers no part
    of the road. `line` are the samples of the centre line."""
    reach = road.wall_offset + 5.0 + 50.0
    offsets = np.arange(-reach, reach + 0.5 * grid.cell, 0.6 * grid.cell)
    s = line.s[:: max(1, round(0.6 * grid.cell / SAMPLE_M))]
    side = np.clip(offsets, -road.wall_offset, road.wall_offset)
    pose = road.track.at(s[:, None], offsets[None, :])
    plane = road.track.at(s[:, None], side[None, :]).z
    limit = plane - SINK_M + BANK_SLOPE * np.maximum(np.abs(offsets) - road.wall_offset - 4.0, 0.0)
    cap = np.full(grid.shape, np.inf)
    i, j, inside = grid.nearest(pose.x, pose.y)
    np.minimum.at(cap, (j[inside], i[inside]), limit[inside])
    # Each sample also limits its neighbours: erosion is the minimum over 3 x 3 points.
    finite = np.where(np.isfinite(cap), cap, 1e9).astype(np.float32)
    return np.asarray(cv2.erode(finite, np.ones((3, 3), np.uint8)), dtype=np.float64)


def _spread(
    road: Road, line: CentreLineSamples, grid: Grid
) -> tuple[FloatArray, FloatArray, NDArray[np.int64]]:
    """Return for each grid point the smoothed height of the nearest road (m), the distance (m) to
    the nearest sample of the centre line, and the index of that sample."""
    points = np.stack(np.meshgrid(*grid.axes), axis=-1).reshape(-1, 2)
    near, index = line.tree.query(points)
    height = road.track.at(line.s).z
    nearest = height[index].reshape(grid.shape).astype(np.float32)
    near = near.reshape(grid.shape)
    # The nearest road's height jumps midway between two roads; blurring removes the step,
    # a wide blur far out and a narrow one beside the road.
    wide = cv2.GaussianBlur(nearest, (0, 0), 60.0 / grid.cell)
    narrow = cv2.GaussianBlur(nearest, (0, 0), 10.0 / grid.cell)
    far = np.clip((near - 25.0) / 60.0, 0.0, 1.0)
    return narrow + (wide - narrow) * far, near, index.reshape(grid.shape)


def _outside(line: CentreLineSamples, grid: Grid) -> FloatArray:
    """Return 1 outside the loop of the centre line `line` and 0 inside, at the points of `grid`,
    with a smooth transition."""
    loop = np.stack([(line.x - grid.x0) / grid.cell, (line.y - grid.y0) / grid.cell], axis=1)
    inside = np.zeros(grid.shape, dtype=np.float32)
    cv2.fillPoly(inside, [np.rint(loop).astype(np.int32)], 1.0)
    return np.asarray(1.0 - cv2.GaussianBlur(inside, (0, 0), 12.0 / grid.cell), dtype=np.float64)


def _rolling(grid: Grid, rng: np.random.Generator) -> FloatArray:
    """Return smooth hills on the grid, positive and negative, standard deviation about 0.5."""
    shape, cell = grid.shape, grid.cell
    hills = np.zeros(shape)
    for wavelength, weight in ((420.0, 0.45), (160.0, 0.2), (60.0, 0.06)):
        knots = (int(shape[0] * cell / wavelength) + 3, int(shape[1] * cell / wavelength) + 3)
        coarse = rng.standard_normal(knots).astype(np.float32)
        size = (round(knots[1] * wavelength / cell), round(knots[0] * wavelength / cell))
        fine = cv2.resize(coarse, size, interpolation=cv2.INTER_CUBIC)
        hills += weight * fine[: shape[0], : shape[1]]
    return hills
