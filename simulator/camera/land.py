"""The terrain grid as triangles: fine cells near the eye, coarse ones to the horizon."""

import numpy as np
from numpy.typing import NDArray

from simulator.camera.mesh import Chunks, Surface
from simulator.camera.terrain import COARSE, Terrain

FloatArray = NDArray[np.float64]

BLOCK = 8
"""A chunk is BLOCK x BLOCK cells."""
COARSE_SINK_M = 4.0


def fine(terrain: Terrain) -> Surface:
    """The full grid; a vertex is x, y, z, normal."""
    return _grid(terrain.x0, terrain.y0, terrain.cell, terrain.z, terrain.normals())


def coarse(terrain: Terrain) -> Surface:
    """The same from every COARSE-th point, sunk so that the fine grid covers it."""
    z = terrain.z[::COARSE, ::COARSE] - COARSE_SINK_M
    step = terrain.cell * COARSE
    normals = terrain.normals()[::COARSE, ::COARSE]
    return _grid(terrain.x0, terrain.y0, step, z, normals)


def _grid(x0: float, y0: float, cell: float, z: FloatArray, normals: FloatArray) -> Surface:
    rows, columns = z.shape
    vertices = np.empty((rows, columns, 6), dtype=np.float32)
    vertices[..., 0] = x0 + cell * np.arange(columns)
    vertices[..., 1] = (y0 + cell * np.arange(rows))[:, None]
    vertices[..., 2] = z
    vertices[..., 3:] = normals
    indices, centres, radii, first, count = [], [], [], [], []
    total = 0
    base = np.array([0, 1, columns, 1, columns + 1, columns])
    for j in range(0, rows - 1, BLOCK):
        for i in range(0, columns - 1, BLOCK):
            height = min(BLOCK, rows - 1 - j)
            width = min(BLOCK, columns - 1 - i)
            corner = (j + np.arange(height))[:, None] * columns + i + np.arange(width)
            indices.append((corner[..., None] + base).reshape(-1))
            part = z[j : j + height + 1, i : i + width + 1]
            low, high = float(part.min()), float(part.max())
            centres.append((i + width / 2, j + height / 2, (low + high) / 2))
            radii.append(np.hypot(np.hypot(width, height) * cell / 2, (high - low) / 2))
            first.append(total)
            count.append(corner.size * 6)
            total += corner.size * 6
    centre = np.array(centres)
    centre[:, 0] = x0 + centre[:, 0] * cell
    centre[:, 1] = y0 + centre[:, 1] * cell
    chunks = Chunks(centre, np.array(radii), np.array([first]), np.array([count]))
    return Surface(vertices.reshape(-1, 6), np.concatenate(indices).astype(np.uint32), chunks)
