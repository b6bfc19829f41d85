"""Boxes and faces, as triangles, from which props and bridges are built.

A vertex is position, normal, colour, (u, v) in metres and material number; the frame is that of the
object, z up, metres.
"""

from collections.abc import Sequence
from functools import cache

import numpy as np

from simulator.arrays import FloatArray

Point = tuple[float, float, float]

MATERIALS = ("plain", "facade", "crowd", "board", "striped", "tiles", "masonry", "earth", "lit")
"""Names of the materials; the index is the material number, prop.frag.glsl uses the names."""
PLAIN, FACADE, CROWD, BOARD, STRIPED, TILES, MASONRY, EARTH, LIT = map(float, range(len(MATERIALS)))


def box(
    size: Point, at: Point, colour: Point, material: float = PLAIN, *, floor: bool = False
) -> FloatArray:
    """A box that stands on `at`, the middle of its floor, (30, 12) or with the floor (36, 12).

    Its sides are of `material`; the top and floor of a facade box are plain.
    """
    rows = _unit_box()[: 36 if floor else 30].copy()
    rows[:, :3] = rows[:, :3] * size + at
    # Extent (u, v) of the faces: y by z for the first two sides, x by z for the next, x by y flat.
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
    """Six faces of a box of 1 m: the sides +x, -x, +y, -y, the top and the floor."""
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
    """The cross product of two vectors; numpy's `cross` takes ten times as long."""
    (ax, ay, az), (bx, by, bz) = a, b
    return np.array([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx])


def face(
    corners: Sequence[FloatArray], uv: Sequence[tuple[float, float]], colour: Point, material: float
) -> FloatArray:
    """A face of four corners, counter-clockwise from outside, as two triangles (6, 12); two
    consecutive corners may be equal."""
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
