"""Builds triangle strips along the road from rows of vertices across it, in levels of detail and
chunks.

A software renderer is slow on triangles smaller than a block of 4 x 4 pixels. Therefore rows are
left out if the remaining rows describe the surface well enough.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from simulator.arrays import FloatArray
from simulator.camera.core.mesh import Chunks, Surface

CHUNK_ROWS = 16
_STEPS = (16, 8, 4, 2, 1)


@dataclass(frozen=True)
class Level:
    """A level of detail, drawn up to `reach_m` from the eye. Rows are left out as long as no point
    moves by more than `error_m` and no triangle becomes longer than `longest_m`."""

    reach_m: float
    error_m: float
    longest_m: float


LEVELS = (
    Level(35.0, 0.003, 8.0),
    Level(100.0, 0.02, 16.0),
    Level(300.0, 0.08, 32.0),
    Level(650.0, 0.3, 64.0),
)
"""Levels of detail of the asphalt; errors are about a quarter of a pixel in the driver view."""


def strip(
    vertices: NDArray[np.float32],
    points: FloatArray,
    s: FloatArray,
    profile: FloatArray,
    cells: Sequence[Sequence[tuple[int, int]]],
    levels: Sequence[Level] = LEVELS,
) -> Surface:
    """Build the triangles between the rows of a vertex grid (R, C, F), with F values a vertex, at
    `points` (R, C, 3), m. The rows are at `s` (R,) m along the road.

    `profile` (R, K) contains the values, in metres, that interpolation between the kept rows must
    reproduce. At level of detail k there are triangles between the columns of each pair in
    `cells[k]`. The first row of every chunk is kept, so that neighbouring chunks of different
    levels share their vertices.
    """
    rows, columns = vertices.shape[:2]
    starts = np.arange(0, rows - 1, CHUNK_ROWS)
    ends = np.minimum(starts + CHUNK_ROWS, rows - 1)
    steps = _steps(s, profile, starts, ends, levels)
    row = np.arange(rows)
    chunk = np.minimum(row // CHUNK_ROWS, len(starts) - 1)
    indices = []
    first, count = np.empty((2, len(levels), len(starts)), dtype=np.int64)
    for k, pairs in enumerate(cells):
        kept = row[((row - starts[chunk]) % steps[k, chunk] == 0) | (row == rows - 1)]
        indices.append(_between(kept, columns, np.array(pairs)))
        begin, end = np.searchsorted(kept, starts), np.searchsorted(kept, ends)
        first[k] = sum(len(part) for part in indices[:-1]) + begin * len(pairs) * 6
        count[k] = (end - begin) * len(pairs) * 6
    low = np.minimum(np.minimum.reduceat(points.min(axis=1), starts), points[ends].min(axis=1))
    high = np.maximum(np.maximum.reduceat(points.max(axis=1), starts), points[ends].max(axis=1))
    return Surface(
        np.ascontiguousarray(vertices.reshape(rows * columns, -1)),
        np.concatenate(indices),
        Chunks(low, high, first, count, tuple(level.reach_m for level in levels)),
    )


def _steps(
    s: FloatArray,
    profile: FloatArray,
    starts: NDArray[np.intp],
    ends: NDArray[np.intp],
    levels: Sequence[Level],
) -> NDArray[np.intp]:
    """Return the spacing of the kept rows, in rows, for each level and chunk (levels, chunks). `s`
    and `profile` are explained in `strip`; `starts` and `ends` (chunks,) are the first and the last
    row of each chunk."""
    steps = np.ones((len(levels), len(starts)), dtype=np.intp)
    row = np.arange(len(s) - 1)
    chunk = row // CHUNK_ROWS
    for step in reversed(_STEPS[:-1]):
        before = starts[chunk] + (row - starts[chunk]) // step * step
        after = np.minimum(before + step, ends[chunk])
        length = s[after] - s[before]
        share = ((s[row] - s[before]) / np.maximum(length, 1e-9))[:, None]
        between = profile[before] + share * (profile[after] - profile[before])
        error = np.maximum.reduceat(np.abs(between - profile[row]).max(axis=1), starts)
        longest = np.maximum.reduceat(length, starts)
        for k, level in enumerate(levels):
            steps[k, (error <= level.error_m) & (longest <= level.longest_m)] = step
    return steps


def _between(rows: NDArray[np.intp], columns: int, sides: NDArray[np.intp]) -> NDArray[np.uint32]:
    """Return the indices of two triangles for each pair of columns in `sides` (n, 2) between
    consecutive `rows` of a grid with `columns` columns. The last (provoking) vertex of a triangle
    determines the triangle's flat attributes; it lies in the earlier row."""
    near, far = columns * rows[:-1, None, None] + sides, columns * rows[1:, None, None] + sides
    corners = [near[..., 0], far[..., 0], near[..., 1], far[..., 0], far[..., 1], near[..., 1]]
    return np.stack(corners, axis=-1).reshape(-1).astype(np.uint32)
