"""The rails and walls along both sides of a road, as one triangle mesh for collisions (metres)."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from simulator.track.road import Road

BELOW_M, ABOVE_M = 1.0, 2.0  # of the road surface at the wall's foot
MAX_STEP_M = 4.0
MAX_TURN = 0.05  # rad of the centre line between two posts: 2.5 cm of sagitta at 80 m radius
FAR_ALONG_M = 60.0  # a part of the track this far off along s counts as another road
STOREY_M = 4.0  # roads farther apart in height than this are a bridge and what it crosses


@dataclass(frozen=True)
class Mesh:
    vertices: NDArray[np.float64]
    """(V, 3), world frame."""
    triangles: NDArray[np.int64]
    """(T, 3), indices into `vertices`."""


def wall_mesh(road: Road) -> Mesh:
    """Both walls of `road`, open where they would stand on another part of the track."""
    stations = _stations(road)
    vertices: list[NDArray[np.float64]] = []
    triangles: list[NDArray[np.int64]] = []
    for side in (1.0, -1.0):
        pose = road.track.at(stations, side * road.wall_offset)
        foot = np.column_stack((pose.x, pose.y, pose.z))
        clear = ~_on_another_road(road, stations, foot)
        up = np.array([0.0, 0.0, 1.0])
        posts = np.stack((foot - BELOW_M * up, foot + ABOVE_M * up), axis=1).reshape(-1, 3)
        first = np.flatnonzero(clear & np.roll(clear, -1))
        second = (first + 1) % len(stations)
        panels = np.column_stack(
            (2 * first, 2 * second, 2 * first + 1, 2 * first + 1, 2 * second, 2 * second + 1)
        )
        triangles.append(panels.reshape(-1, 3) + sum(map(len, vertices)))
        vertices.append(posts)
    return Mesh(np.concatenate(vertices), np.concatenate(triangles))


def _stations(road: Road) -> NDArray[np.float64]:
    """Places along s for wall posts: close where the road bends."""
    track = road.track
    stations = [
        start + length * np.arange(count) / count
        for start, length, curvature in zip(track.s0, track.length, track.curvature0, strict=True)
        for count in [int(np.ceil(max(length / MAX_STEP_M, abs(curvature) * length / MAX_TURN, 1)))]
    ]
    joined = np.concatenate(stations)
    # Spirals come as many short pieces; posts closer than half a metre serve nobody.
    return joined[np.concatenate(([True], np.diff(joined) > 0.5))]


def _on_another_road(
    road: Road, stations: NDArray[np.float64], foot: NDArray[np.float64]
) -> NDArray[np.bool_]:
    """Which wall feet (N, 3) lie within the edge of a part of the track far off along s."""
    s = np.arange(0.0, road.track.length_m, 2.0)
    centre = road.track.at(s)
    covered = np.zeros(len(foot), dtype=np.bool_)
    for start in range(0, len(foot), 256):
        part = slice(start, start + 256)
        apart = np.hypot(foot[part, 0, None] - centre.x, foot[part, 1, None] - centre.y)
        along = np.abs(stations[part, None] - s)
        along = np.minimum(along, road.track.length_m - along)
        near = (apart < road.edge) & (np.abs(foot[part, 2, None] - centre.z) < STOREY_M)
        covered[part] = np.any(near & (along > FAR_ALONG_M), axis=1)
    return covered
