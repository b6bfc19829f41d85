"""The rails and walls along both sides of a road, as the collision geometry near one car.

A car collides with a panel: an upright box, tangent to the wall at the point nearest to the car.
Unlike a mesh it has no inner edges on which a car catches, and it is too thick to be crossed within
one physics step. Metres, world frame.
"""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from runtime.jit import compiled
from simulator.arrays import FloatArray
from simulator.track.piece_table import TRACK_LENGTH, Table, index_at, pose_at, surface
from simulator.track.road import Road
from simulator.world.boxes import AXES, CENTRE, HALF

PANEL = (6.0, 3.0, 8.0)
"""Length, thickness and height (m) of a panel."""
FOOT_M = 3.0  # depth of the panel below the road
FAR_ALONG_M = 60.0  # parts of the track farther apart than this along s count as separate parts
MIN_BRIDGE_HEIGHT_M = 4.0  # least height of the upper road above the lower road at a bridge
_STEP_M = 1.0
_CENTRE_STEP_M = 2.0
_MIN_RADIUS_M = 1.0  # least distance of a wall from the centre of a bend
_ROW = 6


WallTable = tuple[float, NDArray[np.bool_], NDArray[np.bool_]]
"""Walls for compiled code: their distance (m) from the track's centre, and whether there is a left
and a right wall in each of N equal cells along s (N,)."""


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
        self._table: Table = road.track.arrays()
        length = road.track.length_m
        cells = math.ceil(length / _STEP_M)
        stations = (np.arange(cells) + 0.5) * (length / cells)
        left, right = (_wall_present(road, stations, side) for side in (1, -1))
        self.arrays: WallTable = (road.wall_offset, left, right)

    @property
    def offset(self) -> float:
        """Distance (m) of the walls from the track's centre."""
        return self.arrays[0]

    def panel(self, s: float, to_middle: float, reach: float) -> Panel | None:
        """Return the panel of a wall within `reach` m of a car at (s, to_middle) m; None if there
        is none.

        A car behind the wall (it passed through an opening) gets no panel.
        """
        row = np.empty(_ROW)
        if not panel_beside(self._table, self.arrays, s, to_middle, reach, row):
            return None
        x, y, z, yaw, *face = row.tolist()
        return Panel(x, y, z, yaw, (face[0], face[1]))


@compiled
def panel_beside(
    table: Table, walls: WallTable, s: float, to_middle: float, reach: float, row: FloatArray
) -> bool:
    """Fill `row` (6,) with x, y, z, yaw of the centre of the panel beside a car at (s, to_middle)
    m, and x, y of the middle of the panel's side that faces the road. Returns False, without
    filling `row`, if there is no wall within `reach` m."""
    offset = walls[0]
    if not offset - reach < abs(to_middle) < offset:
        return False
    side = 1.0 if to_middle > 0.0 else -1.0
    present = walls[1] if to_middle > 0.0 else walls[2]
    if not present[int(s / table[0, TRACK_LENGTH] * len(present)) % len(present)]:
        return False
    x, y, _, heading, _ = pose_at(table, s)
    z, _, _, _ = surface(table, index_at(table, s), s, side * offset)
    left_x, left_y = -math.sin(heading), math.cos(heading)
    row[4], row[5] = x + side * offset * left_x, y + side * offset * left_y
    behind = 0.5 * side * PANEL[1]
    row[0], row[1] = row[4] + behind * left_x, row[5] + behind * left_y
    row[2], row[3] = z + 0.5 * PANEL[2] - FOOT_M, heading
    return True


@compiled
def fill_panel_box(
    table: Table, walls: WallTable, s: float, to_middle: float, reach: float, box: FloatArray
) -> bool:
    """Fill `box` (15,) (see `boxes`) with the box of the panel beside a car at (s, to_middle) m.
    Returns False, without filling `box`, if there is no wall within `reach` m."""
    row = np.empty(_ROW)
    if not panel_beside(table, walls, s, to_middle, reach, row):
        return False
    cos, sin = math.cos(row[3]), math.sin(row[3])
    for i in range(box.shape[0]):
        box[i] = 0.0
    for i in range(3):
        box[CENTRE + i] = row[i]
    box[AXES], box[AXES + 1] = cos, sin
    box[AXES + 3], box[AXES + 4] = -sin, cos
    box[AXES + 8] = 1.0
    for i in range(3):
        box[HALF + i] = 0.5 * PANEL[i]
    return True


def _wall_present(road: Road, stations: NDArray[Any], side: int) -> NDArray[np.bool_]:
    """Return whether a wall stands on `side` (1 left, -1 right) at each of `stations` (N,) m."""
    pose = road.track.at(stations, side * road.wall_offset)
    foot = np.column_stack((pose.x, pose.y, pose.z))
    bend = road.track.at(stations).curvature
    stands = 1.0 - side * road.wall_offset * bend > _MIN_RADIUS_M * np.abs(bend)
    return np.asarray(stands & ~_on_another_road(road, stations, foot))


def _on_another_road(
    road: Road, stations: NDArray[np.float64], foot: NDArray[np.float64]
) -> NDArray[np.bool_]:
    """Return whether each wall foot (N, 3) at s = `stations` (N,) m lies on another part of the
    track, that is, within the road's edge at a place more than 60 m away along the lap."""
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
    """Return for each wall foot `foot` (N, 3) at s = `stations` (N,) whether it lies on another
    part of the track: within `edge` m of a point of the centre line `centre` (M, 3), every 2 m,
    that is more than 60 m away along the lap of `length` m and less than 4 m higher or lower."""
    covered = np.zeros(foot.shape[0], dtype=np.bool_)
    for i in range(foot.shape[0]):
        k = 0
        while k < centre.shape[0]:
            apart = math.hypot(foot[i, 0] - centre[k, 0], foot[i, 1] - centre[k, 1])
            if apart >= edge:
                # Skip the points of the centre line that cannot be within `edge` of the foot: the
                # distance along the line between two points is never less than the straight one.
                k += max(int((apart - edge) / _CENTRE_STEP_M), 1)
                continue
            along = abs(stations[i] - k * _CENTRE_STEP_M)
            along = min(along, length - along)
            if along > FAR_ALONG_M and abs(foot[i, 2] - centre[k, 2]) < MIN_BRIDGE_HEIGHT_M:
                covered[i] = True
                break
            k += 1
    return covered
