"""Boxes and faces as triangles; props and bridges are built of them.

A vertex has 12 values: position (3), normal (3), colour (3), texture coordinates u, v, and material
number. The texture coordinates are in metres, on lettered boards in shares of the board's sides.
The frame is the frame of the prop or bridge, z up, metres.
"""

from collections.abc import Sequence
from functools import cache

import numpy as np

from simulator.arrays import FloatArray

Point = tuple[float, float, float]

MATERIALS = ("plain", "facade", "crowd", "board", "striped", "tiles", "masonry", "earth", "lit")
"""Names of the materials. The index is the material number; prop.frag.glsl uses the names."""
PLAIN, FACADE, CROWD, BOARD, STRIPED, TILES, MASONRY, EARTH, LIT = map(float, range(len(MATERIALS)))


def box(
    size: Point, at: Point, colour: Point, material: float = PLAIN, *, floor: bool = False
) -> FloatArray:
    """Return a box of `size` (x, y, z), m, as vertices (30, 12), or (36, 12) with its floor. `at`
    (x, y, z), m, is the middle of the floor.

    All faces have the `material`, except that top and floor of a box of FACADE are PLAIN.
    """
    rows = _unit_box()[: 36 if floor else 30].copy()
    rows[:, :3] = rows[:, :3] * size + at
    # Extents (u, v): (y, z) of the sides +x and -x, (x, z) of +y and -y, (x, y) of top and floor.
    x, y, z = size
    rows[:12, 9:11] *= (y, z)
    rows[12:24, 9:11] *= (x, z)
    rows[24:, 9:11] *= (x, y)
    rows[:, 6:9] = colour
    rows[:24, 11] = material
    rows[24:, 11] = PLAIN if material == FACADE else material
    return rows


@cache
def _unit_box() -> FloatArray:
    """Return the faces (36, 12) of a box of 1 m: the sides +x, -x, +y, -y, the top, the floor."""
    up, uv = np.array([0.0, 0.0, 1.0]), ((0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0))
    black = (0.0, 0.0, 0.0)
    faces = []
    for x, y in ((1, 0), (-1, 0), (0, 1), (0, -1)):
        middle, along = np.array([x, y, 0.0]) / 2, np.array([-y, x, 0.0]) / 2
        corners = [middle - along, middle + along, middle + along + up, middle - along + up]
        faces.append(face(corners, uv, black, PLAIN))
    ring = [np.array([x, y, 0.0]) / 2 for x, y in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
    faces.append(face([corner + up for corner in ring], uv, black, PLAIN))
    faces.append(face([ring[k] for k in (0, 3, 2, 1)], uv, black, PLAIN))
    return np.concatenate(faces)


def _normal(a: FloatArray, b: FloatArray) -> FloatArray:
    """Return the cross product of two vectors (3,); `numpy.cross` takes ten times as long."""
    (ax, ay, az), (bx, by, bz) = a, b
    return np.array([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx])


def face(
    corners: Sequence[FloatArray], uv: Sequence[tuple[float, float]], colour: Point, material: float
) -> FloatArray:
    """Return a face with four corners (3,), m, counter-clockwise from outside, as two triangles
    (6, 12). Two consecutive corners may be equal. `uv` are the texture coordinates of the corners,
    `colour` is linear RGB, `material` a material number."""
    rows = np.empty((6, 12))
    order = [0, 1, 2, 0, 2, 3]
    rows[:, :3] = np.array(corners)[order]
    normal = _normal(corners[1] - corners[0], corners[2] - corners[0])
    if normal @ normal < 1e-18:
        normal = _normal(corners[2] - corners[0], corners[3] - corners[0])
    rows[:, 3:6] = normal / max(float(np.sqrt(normal @ normal)), 1e-9)
    rows[:, 6:9] = colour
    rows[:, 9:11] = np.array(uv)[order]
    rows[:, 11] = material
    return rows
