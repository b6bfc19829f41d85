"""Cars and roads as arrays for compiled code: one row per car, one row per road.

A control step reads and writes only these arrays, so that one compiled call can step many cars.
World frame and SI units, as in `world`. Counts and codes are stored as floats.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from simulator.arrays import FloatArray
from simulator.track.geometry import Track
from simulator.track.piece_table import COLUMNS
from simulator.track.road import Road
from simulator.traffic.wreck import TRAFFIC_CAR
from simulator.vehicle.car import CarParameters
from simulator.vehicle.dynamics import MEMORY, MOTION
from simulator.vehicle.state import Collision
from simulator.vehicle.surface import ground
from simulator.vehicle.track_state import TRACK_STATE_SIZE
from simulator.world.walls import Walls

# A row of `cars` (CAR,): motion, internal state, track state (`vehicle.dynamics`, `track_state`),
# command (steer, throttle, brake, gear), then counts since the start of the episode.
MOTION_AT = 0
MEMORY_AT = MOTION_AT + MOTION
TRACK_AT = MEMORY_AT + MEMORY
COMMAND_AT = TRACK_AT + TRACK_STATE_SIZE
STEPS, LAP, LAP_START = COMMAND_AT + 4, COMMAND_AT + 5, COMMAND_AT + 6
# Row of the car's road; number of traffic cars; physics steps done of this control step; what the
# car touched in it (index into COLLISIONS); whether it touched something in the last physics step;
# whether the compiled control step leaves the car out.
ROAD, TRAFFIC, DONE, TOUCHED, IN_CONTACT, SKIPPED = (LAP_START + k for k in range(1, 7))
CAR = 48
COLLISIONS: tuple[Collision | None, ...] = (None, "wall", "traffic")
WALL, OTHER_CAR = 1, 2

# A row of `roads` (ROAD_SIZE,): its rows of `tables` and of the walls, its ground (`surface`), and
# measures of the road (`Road`); then for each marking the two offsets of its lines.
TABLE_BEGIN, TABLE_END, WALLS_BEGIN, WALLS_END, GROUND_AT = 0, 1, 2, 3, 4
WALL_OFFSET, EDGE, HALF_WIDTH, LANES, LANE_WIDTH, LINES_AT = 9, 10, 11, 12, 13, 14
MARKINGS = 4
ROAD_SIZE = LINES_AT + 2 * MARKINGS

Arrays = tuple[
    FloatArray,
    NDArray[Any],
    NDArray[Any],
    FloatArray,
    NDArray[np.bool_],
    NDArray[np.bool_],
    FloatArray,
    FloatArray,
    FloatArray,
]
"""cars (N, CAR), parameters of the cars (N,) and of a traffic car (1,), tables (P, COLUMNS), left
and right walls (C,), roads (R, ROAD_SIZE), and for each car the poses of its traffic (N, T, 6) at
the start of the control step and their change over it (N, T, 6)."""


class Fleet:
    """`count` cars and their roads; several cars may share a road."""

    def __init__(self, count: int) -> None:
        self.cars = np.zeros((count, CAR))
        self.params = np.concatenate([CarParameters().packed()] * count)
        self.others, self.move = np.zeros((2, count, 0, 6))
        self._other = TRAFFIC_CAR.packed()
        self._tables = _Rows(np.zeros((0, COLUMNS)))
        self._left, self._right = (_Rows(np.zeros(0, np.bool_)) for _ in range(2))
        self._roads = _Rows(np.zeros((0, ROAD_SIZE)))
        # Roads and tracks by id; the objects are kept, so that no other object gets their ids.
        self._row_of: dict[int, tuple[int, Road, Walls]] = {}
        self._table_of: dict[int, tuple[int, int, Track]] = {}
        self._update()

    def assign(self, number: int, road: Road, car: CarParameters, traffic: int) -> Walls:
        """Put car `number` with the parameters `car` and room for `traffic` traffic cars on `road`;
        returns the road's walls."""
        row, _, walls = self._row_of.get(id(road)) or self._add(road)
        self.cars[number] = 0.0
        self.cars[number, [ROAD, TRAFFIC]] = row, traffic
        self.params[number] = car.packed()[0]
        if traffic > self.others.shape[1]:
            missing = ((0, 0), (0, traffic - self.others.shape[1]), (0, 0))
            self.others, self.move = np.pad(self.others, missing), np.pad(self.move, missing)
        self._update()
        return walls

    def _add(self, road: Road) -> tuple[int, Road, Walls]:
        """Add the row of `road`, its table and its walls to the arrays."""
        walls = Walls(road)
        begin, end = self._table_rows(road.track)
        row = np.zeros(ROAD_SIZE)
        row[TABLE_BEGIN : TABLE_END + 1] = begin, end
        row[WALLS_BEGIN : WALLS_END + 1] = self._left.append(walls.arrays[1])
        self._right.append(walls.arrays[2])
        row[GROUND_AT:WALL_OFFSET] = ground(road)
        row[WALL_OFFSET:LINES_AT] = (
            *(road.wall_offset, road.edge, road.half_width),
            *(road.lanes, road.lane_width),
        )
        offsets = np.array(road.line_offsets).ravel()
        row[LINES_AT : LINES_AT + len(offsets)] = offsets
        place, _ = self._roads.append(row[np.newaxis])
        self._row_of[id(road)] = place, road, walls
        return self._row_of[id(road)]

    def _table_rows(self, track: Track) -> tuple[int, int]:
        """Return the begin and end of the track's rows in `tables`, added if new."""
        if id(track) not in self._table_of:
            self._table_of[id(track)] = *self._tables.append(track.arrays()), track
        begin, end, _ = self._table_of[id(track)]
        return begin, end

    def _update(self) -> None:
        """Rebuild `arrays`, because an append can replace an array."""
        self.arrays: Arrays = (
            self.cars,
            self.params,
            self._other,
            self._tables.array,
            self._left.array,
            self._right.array,
            self._roads.array,
            self.others,
            self.move,
        )


class _Rows:
    """An array that grows; its memory doubles when full, so many small additions are fast."""

    def __init__(self, empty: NDArray[Any]) -> None:
        self.array = self._memory = empty

    def append(self, rows: NDArray[Any]) -> tuple[int, int]:
        """Append `rows`; returns the index of the first row and the index after the last one."""
        begin, end = len(self.array), len(self.array) + len(rows)
        if end > len(self._memory):
            grown = np.zeros((max(end, 2 * begin), *rows.shape[1:]), rows.dtype)
            grown[:begin] = self.array
            self._memory = grown
        self._memory[begin:end] = rows
        self.array = self._memory[:end]
        return begin, end
