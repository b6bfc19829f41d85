"""The rails and walls along both sides of a road, as the collision geometry near one car.

A car collides with a panel: an upright box, tangent to the wall where the car is nearest to it.
Unlike a mesh it has no inner edges to catch on, and it is too thick to be crossed within one
physics step. Metres, world frame.
"""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from runtime.jit import compiled
from simulator.track.piece_table import Table, index_at, pose_at, surface
from simulator.track.road import Road

PANEL = (6.0, 3.0, 8.0)
"""Length, thickness and height of a panel."""
FOOT_M = 3.0  # depth of the panel below the road
FAR_ALONG_M = 60.0  # farther along s than this, a part of the track counts as another road
MIN_BRIDGE_HEIGHT_M = 4.0  # above this height difference, one road is a bridge over the other
_STEP_M = 1.0
_CENTRE_STEP_M = 2.0
_MIN_RADIUS_M = 1.0  # no wall this near to the centre of a bend


@dataclass(frozen=True)
class Panel:
    """Position of a panel's centre (m), and its direction (yaw, rad)."""

    x: float
    y: float
    z: float
    yaw: float
    face: tuple[float, float]
    """x, y of the middle of the side that faces the road."""


class Walls:
    """Both walls of a road, with openings where they would stand on another part of the track."""

    def __init__(self, road: Road) -> None:
        self.offset = road.wall_offset
        self._table: Table = road.track.arrays()
        self._length = road.track.length_m
        cells = math.ceil(self._length / _STEP_M)
        stations = (np.arange(cells) + 0.5) * (self._length / cells)
        self._present = {side: _wall_present(road, stations, side) for side in (1, -1)}

    def panel(self, s: float, to_middle: float, reach: float) -> Panel | None:
        """The panel of the wall within `reach` m of a car at (s, to_middle), None if there is none.

        A car behind the wall (it passed through an opening) gets no panel.
        """
        side = 1 if to_middle > 0.0 else -1
        if not self.offset - reach < abs(to_middle) < self.offset:
            return None
        present = self._present[side]
        if not present[int(s / self._length * len(present)) % len(present)]:
            return None
        x, y, _, heading, _ = pose_at(self._table, s)
        z, _, _, _ = surface(self._table, index_at(self._table, s), s, side * self.offset)
        out, left = side * self.offset, (-math.sin(heading), math.cos(heading))
        face = (x + out * left[0], y + out * left[1])
        behind, up = side * 0.5 * PANEL[1], 0.5 * PANEL[2] - FOOT_M
        return Panel(face[0] + behind * left[0], face[1] + behind * left[1], z + up, heading, face)


def _wall_present(road: Road, stations: NDArray[Any], side: int) -> NDArray[np.bool_]:
    """(N,) whether there is a wall on this side at each of `stations` (N,) along s."""
    pose = road.track.at(stations, side * road.wall_offset)
    foot = np.column_stack((pose.x, pose.y, pose.z))
    bend = road.track.at(stations).curvature
    stands = 1.0 - side * road.wall_offset * bend > _MIN_RADIUS_M * np.abs(bend)
    return np.asarray(stands & ~_on_another_road(road, stations, foot))


def _on_another_road(
    road: Road, stations: NDArray[np.float64], foot: NDArray[np.float64]
) -> NDArray[np.bool_]:
    """(N,) whether a wall foot (N, 3) lies within the edge of a part of the track far along s."""
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
    """(N,) whether each of `foot` (N, 3) at `stations` (N,) lies within `edge` m of a point of the
    centre line `centre` (M, 3), spaced _CENTRE_STEP_M, that is far along s."""
    covered = np.zeros(foot.shape[0], dtype=np.bool_)
    for i in range(foot.shape[0]):
        k = 0
        while k < centre.shape[0]:
            apart = math.hypot(foot[i, 0] - centre[k, 0], foot[i, 1] - centre[k, 1])
            if apart >= edge:
                # Skip the points that cannot lie within the edge: distance along the line is
                # never less than the straight distance.
                k += max(int((apart - edge) / _CENTRE_STEP_M), 1)
                continue
            along = abs(stations[i] - k * _CENTRE_STEP_M)
            along = min(along, length - along)
            if along > FAR_ALONG_M and abs(foot[i, 2] - centre[k, 2]) < MIN_BRIDGE_HEIGHT_M:
                covered[i] = True
                break
            k += 1
    return covered
