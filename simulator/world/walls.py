"""The rails and walls along both sides of a road, of which a car only ever meets a small piece.

That piece is a panel: an upright slab, tangent to the wall where the car is nearest to it. Unlike a
mesh it has no inner edges to catch on, and it is too thick to be crossed within a physics step.
Metres, world frame.
"""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from runtime.jit import compiled
from simulator.track.kernel import Table, index_at, pose_at, surface
from simulator.track.road import Road

PANEL = (6.0, 3.0, 8.0)
"""Length, thickness and height of a panel."""
FOOT_M = 3.0  # of the panel below the road
FAR_ALONG_M = 60.0  # a part of the track this far off along s counts as another road
STOREY_M = 4.0  # roads farther apart in height than this are a bridge and what it crosses
_STEP_M = 1.0
_CENTRE_STEP_M = 2.0
_LEAST_RADIUS_M = 1.0  # a wall this near to a bend's centre stands nowhere


@dataclass(frozen=True)
class Panel:
    """Where a panel's middle is, and which way it runs."""

    x: float
    y: float
    z: float
    yaw: float
    face: tuple[float, float]
    """x, y of the middle of the side that looks at the road."""


class Walls:
    """Both walls of a road, open where they would stand on another part of the track."""

    def __init__(self, road: Road) -> None:
        self.offset = road.wall_offset
        self._table: Table = road.track.arrays()
        self._length = road.track.length_m
        cells = math.ceil(self._length / _STEP_M)
        stations = (np.arange(cells) + 0.5) * (self._length / cells)
        self._clear = {side: _clear(road, stations, side) for side in (1, -1)}

    def panel(self, s: float, to_middle: float, reach: float) -> Panel | None:
        """The piece of wall within `reach` m of a car at (s, to_middle), if there is one.

        A car that has got behind the wall, through an opening, meets none.
        """
        side = 1 if to_middle > 0.0 else -1
        if not self.offset - reach < abs(to_middle) < self.offset:
            return None
        clear = self._clear[side]
        if not clear[int(s / self._length * len(clear)) % len(clear)]:
            return None
        x, y, _, heading, _ = pose_at(self._table, s)
        z, _, _, _ = surface(self._table, index_at(self._table, s), s, side * self.offset)
        out, left = side * self.offset, (-math.sin(heading), math.cos(heading))
        face = (x + out * left[0], y + out * left[1])
        behind, up = side * 0.5 * PANEL[1], 0.5 * PANEL[2] - FOOT_M
        return Panel(face[0] + behind * left[0], face[1] + behind * left[1], z + up, heading, face)


def _clear(road: Road, stations: NDArray[Any], side: int) -> NDArray[np.bool_]:
    """At which stations (N,) along s the wall of one side stands."""
    pose = road.track.at(stations, side * road.wall_offset)
    foot = np.column_stack((pose.x, pose.y, pose.z))
    bend = road.track.at(stations).curvature
    stands = 1.0 - side * road.wall_offset * bend > _LEAST_RADIUS_M * np.abs(bend)
    return np.asarray(stands & ~_on_another_road(road, stations, foot))


def _on_another_road(
    road: Road, stations: NDArray[np.float64], foot: NDArray[np.float64]
) -> NDArray[np.bool_]:
    """Which wall feet (N, 3) lie within the edge of a part of the track far off along s."""
    centre = road.track.at(np.arange(0.0, road.track.length_m, _CENTRE_STEP_M))
    points = np.column_stack((centre.x, centre.y, centre.z))
    return covered_elsewhere(stations, foot, points, road.track.length_m, road.edge)


@compiled
def covered_elsewhere(
    stations: NDArray[np.float64],
    foot: NDArray[np.float64],
    centre: NDArray[np.float64],
    length: float,
    edge: float,
) -> NDArray[np.bool_]:
    """Which of `foot` (N, 3) at `stations` lie within `edge` of a far-off point of `centre` (M, 3),
    which are _CENTRE_STEP_M apart along the line."""
    covered = np.zeros(foot.shape[0], dtype=np.bool_)
    for i in range(foot.shape[0]):
        k = 0
        while k < centre.shape[0]:
            apart = math.hypot(foot[i, 0] - centre[k, 0], foot[i, 1] - centre[k, 1])
            if apart >= edge:
                # No point that is nearer along the line than that can lie within the edge.
                k += max(int((apart - edge) / _CENTRE_STEP_M), 1)
                continue
            along = abs(stations[i] - k * _CENTRE_STEP_M)
            along = min(along, length - along)
            if along > FAR_ALONG_M and abs(foot[i, 2] - centre[k, 2]) < STOREY_M:
                covered[i] = True
                break
            k += 1
    return covered
