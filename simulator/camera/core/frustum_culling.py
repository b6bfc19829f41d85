"""Frustum culling in compiled code: tests bounding spheres against the side planes of a view."""

import numpy as np
from numpy.typing import NDArray

from runtime.jit import compiled
from simulator.arrays import FloatArray


@compiled
def visible_runs(
    spheres: FloatArray,
    first: NDArray[np.int64],
    count: NDArray[np.int64],
    reaches: FloatArray,
    nearest: float,
    eye: FloatArray,
    planes: FloatArray,
    runs: NDArray[np.int64],
) -> int:
    """Write the visible runs of vertex indices into `runs` (at least N, 2), as first index and
    number of indices; returns the number of runs.

    `spheres` (N, 4) are the centres and radii (m, world) of spheres round the N chunks of a mesh.
    `eye` (3,), m, is the viewpoint, `planes` (4, 3) are the inward normals of the side planes of
    the view. `first` and `count` (levels, N) are the runs of the chunks at each level of detail,
    finest first. A chunk is drawn at the first level whose entry of `reaches` (levels,), m, is not
    less than the distance from the eye to the sphere. Chunks that lie completely within `nearest`
    (m) of the eye are left out; adjacent runs are merged.
    """
    found, end = 0, -1
    for k in range(len(spheres)):
        x, y, z = spheres[k, 0] - eye[0], spheres[k, 1] - eye[1], spheres[k, 2] - eye[2]
        radius = spheres[k, 3]
        start = np.sqrt(x * x + y * y + z * z) - radius
        level = 0
        while level < len(reaches) and start > reaches[level]:
            level += 1
        if level == len(reaches) or start + 2.0 * radius <= nearest:
            continue
        if not _intersects(x, y, z, radius, planes):
            continue
        if count[level, k] == 0:
            continue
        if first[level, k] == end:
            runs[found - 1, 1] += count[level, k]
        else:
            runs[found, 0], runs[found, 1] = first[level, k], count[level, k]
            found += 1
        end = first[level, k] + count[level, k]
    return found


@compiled
def visible_spheres(
    centres: FloatArray,
    radii: FloatArray,
    reach: float,
    most: int,
    eye: FloatArray,
    planes: FloatArray,
) -> NDArray[np.int64]:
    """Return the indices, nearest first, of at most `most` spheres that intersect the view frustum
    and whose centres are within `reach` (m) of the eye. `centres` (N, 3), `radii` (N,) and `eye`
    (3,) are in m, world; `planes` (4, 3) are the inward normals of the side planes."""
    chosen = np.empty(len(centres), dtype=np.int64)
    distance = np.empty(len(centres))
    found = 0
    for k in range(len(centres)):
        x, y, z = centres[k, 0] - eye[0], centres[k, 1] - eye[1], centres[k, 2] - eye[2]
        squared = x * x + y * y + z * z
        if squared < reach * reach and _intersects(x, y, z, radii[k], planes):
            chosen[found], distance[found] = k, squared
            found += 1
    order = np.argsort(distance[:found], kind="mergesort")
    return chosen[order[:most]]


@compiled
def _intersects(x: float, y: float, z: float, radius: float, planes: FloatArray) -> bool:
    """Return whether a part of a sphere lies inside all side planes. The centre (`x`, `y`, `z`) is
    relative to the eye; all lengths are in m. `planes` (4, 3) are the inward normals."""
    inside = True
    for plane in planes:
        inside &= x * plane[0] + y * plane[1] + z * plane[2] > -radius
    return inside
