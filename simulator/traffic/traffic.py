"""Traffic: up to twelve cars that keep their lanes, their distance and their temper.

Cars drive in driving direction at 40 to 62 km/h by the intelligent driver model, slow down for
bends, and change lanes where both gaps are safe and it pays. They take the ego car for one of
theirs. Track frame: s along the centre line, to_middle left positive, m and m/s.
"""

import math

import numpy as np
from numpy.typing import NDArray

from simulator.track.geometry import Track
from simulator.track.road import START_BEFORE_LINE_M, Road
from simulator.traffic import kernel
from simulator.traffic.idm import (
    COMFORTABLE_BRAKING,
    STANDSTILL_GAP_M,
    TIME_HEADWAY_S,
    idm_acceleration,
)
from simulator.traffic.wreck import TRAFFIC_CAR
from simulator.vehicle.car import CarParameters
from trackfeatures.errors import UserError

__all__ = ["EGO_SIZE", "MOST_CARS", "SIZE", "Traffic", "idm_acceleration"]

FloatArray = NDArray[np.float64]

SIZE = (TRAFFIC_CAR.length, TRAFFIC_CAR.width, TRAFFIC_CAR.height)
"""Length, width, height of a traffic car, m."""
EGO_SIZE = (CarParameters.length, CarParameters.width, CarParameters.height)
MOST_CARS = 12
DESIRED_KMH = (40.0, 62.0)
CLEAR_M = 25.0
"""No car starts nearer to the ego car (bumper to bumper)."""
SPREAD_M = 600.0
"""Cars start within this way ahead of the ego car, where it meets them; farther if crowded."""
SIDE_ACCELERATION = 3.0
"""m/s2: cars take bends no faster than this."""

_PER_CAR_M = 50.0  # of the way ahead, at least, before the spread is widened
_LEAST_SPACING_M = SIZE[0] + 12.0
_CELL_M = 1.0


class Traffic:
    """`count` cars on `road`, placed by `rng` and from then on without chance.

    `clear_s` is where the ego car starts (default: 25 m before the line). Raises UserError when
    the road has no room for so many cars.
    """

    def __init__(
        self, road: Road, count: int, rng: np.random.Generator, *, clear_s: float | None = None
    ) -> None:
        self.road = road
        self.count = count
        self._length = road.track.length_m
        self._table = road.track.arrays()
        markings = road.markings_y
        self._lane_y = 0.5 * (markings[:-1] + markings[1:])
        start = self._length - START_BEFORE_LINE_M if clear_s is None else clear_s
        self._limit = _bends(road.track, float(np.max(self._lane_y)))
        self._cars = self._start(count, rng, start % self._length)
        self._bodies = np.zeros((count + 1, kernel.BODY_COLUMNS))
        self._poses = np.zeros((count, 6))
        self._see_ego(start % self._length, 0.0, 0.0)
        self._show()

    @property
    def s(self) -> FloatArray:
        """(n,) m along the centre line, of the car's centre."""
        return self._cars[:, kernel.S].copy()

    @property
    def to_middle(self) -> FloatArray:
        """(n,) m, left positive."""
        return self._cars[:, kernel.Y].copy()

    @property
    def speed(self) -> FloatArray:
        """(n,) m/s along the lane."""
        return self._cars[:, kernel.SPEED].copy()

    @property
    def desired_speed(self) -> FloatArray:
        """(n,) m/s each car would drive on a free, straight road."""
        return self._cars[:, kernel.DESIRED].copy()

    def poses(self) -> FloatArray:
        """(n, 6) x, y, z, roll, pitch, yaw of the ground point under each car's centre."""
        return self._poses.copy()

    def step(self, dt: float, ego_s: float, ego_to_middle: float, ego_speed: float) -> None:
        """Advances all cars by `dt` s; the ego car is a leader or follower like any other."""
        if self.count == 0:
            return
        self._see_ego(ego_s, ego_to_middle, ego_speed)
        kernel.advance(
            self._cars,
            self._bodies,
            dt,
            self._length,
            self._lane_y,
            self._table,
            self._limit,
            0.5 * SIZE[0],
            0.5 * SIZE[1],
        )
        kernel.place(self._cars, self._table, self._poses)

    @property
    def struck(self) -> NDArray[np.bool_]:
        """(n,) which cars were hit: they are out of the lanes' order and only in the way."""
        return self._cars[:, kernel.STRUCK] > 0.0

    def strike(self, row: int) -> None:
        """Take car `row` out of the lanes' order: from now on `displace` says where it is."""
        self._cars[row, kernel.STRUCK] = 1.0
        self._cars[row, kernel.DONE] = 1.0

    def displace(self, row: int, pose: FloatArray, place: FloatArray) -> None:
        """Put a struck car on its ground `pose` (6,); `place`: (s, to_middle, angle, speed along
        the track). The others see the whole of its breadth and length as it lies."""
        s, to_middle, angle, speed = place
        cos, sin = abs(math.cos(angle)), abs(math.sin(angle))
        half_length = 0.5 * (SIZE[0] * cos + SIZE[1] * sin)
        half_width = 0.5 * (SIZE[0] * sin + SIZE[1] * cos)
        self._poses[row] = pose
        self._cars[row, [kernel.S, kernel.Y, kernel.SPEED]] = s, to_middle, speed
        left, right = to_middle + half_width, to_middle - half_width
        seen = max(speed, 0.0)
        self._bodies[row] = (s, right, left, seen, half_length, max(seen, 1.0))

    def leader(
        self, s: float, to_middle: float, exclude: int | None = None
    ) -> tuple[float, float] | None:
        """Nearest car ahead in the way of a car of the ego's size: (bumper gap m, speed m/s)."""
        return self._neighbour(s, to_middle, exclude, ahead=True)

    def follower(
        self, s: float, to_middle: float, exclude: int | None = None
    ) -> tuple[float, float] | None:
        """Nearest car behind, as `leader`."""
        return self._neighbour(s, to_middle, exclude, ahead=False)

    def has_room(self, s: float, to_middle: float, speed: float) -> bool:
        """Whether the ego car at `s` may move over to `to_middle` with both gaps safe."""
        half = 0.5 * EGO_SIZE[1]
        safe, _ = kernel.room_in(
            self._bodies,
            self.count,
            s,
            speed,
            to_middle - half,
            to_middle + half,
            0.5 * EGO_SIZE[0],
            self._length,
        )
        return bool(safe)

    def _neighbour(
        self, s: float, to_middle: float, exclude: int | None, *, ahead: bool
    ) -> tuple[float, float] | None:
        half = 0.5 * EGO_SIZE[1]
        row, gap = kernel.neighbour(
            self._bodies[: self.count],
            -1 if exclude is None else exclude,
            s,
            to_middle - half,
            to_middle + half,
            0.5 * EGO_SIZE[0],
            self._length,
            ahead,
        )
        return None if row < 0 else (float(gap), float(self._bodies[row, kernel.B_SPEED]))

    def _see_ego(self, s: float, to_middle: float, speed: float) -> None:
        half = 0.5 * EGO_SIZE[1]
        # The ego car's own wish is unknown; it is taken to be content with its speed.
        self._bodies[self.count] = (
            s % self._length,
            to_middle - half,
            to_middle + half,
            speed,
            0.5 * EGO_SIZE[0],
            max(speed, 1.0),
        )

    def _show(self) -> None:
        kernel.show(self._cars, self._bodies, 0.5 * SIZE[0], 0.5 * SIZE[1])
        kernel.place(self._cars, self._table, self._poses)

    def _start(self, count: int, rng: np.random.Generator, clear_s: float) -> FloatArray:
        nearest = CLEAR_M + 0.5 * (SIZE[0] + EGO_SIZE[0])
        room = self._length - 2 * nearest
        lanes = len(self._lane_y)
        if not isinstance(count, int | np.integer) or isinstance(count, bool):
            raise UserError(f"the number of traffic cars is {count!r}; give a whole number")
        fits = min(lanes * max(int(room / _LEAST_SPACING_M), 0), MOST_CARS)
        if not 0 <= count <= fits:
            raise UserError(
                f"{count} traffic cars asked for, but {self.road.track.name!r} with {lanes} "
                f"lane(s) takes 0 to {fits}; ask for fewer"
            )
        cars = np.zeros((count, kernel.CAR_COLUMNS))
        lane = rng.permutation(np.arange(count) % lanes)
        reach = min(room, max(SPREAD_M, _PER_CAR_M * count))
        for number in range(lanes):
            rows = np.flatnonzero(lane == number)
            ahead = nearest + _spread(len(rows), reach, rng)
            cars[rows, kernel.S] = (clear_s + ahead) % self._length
            cars[rows, kernel.Y] = self._lane_y[number]
            cars[rows, kernel.DESIRED] = rng.uniform(*DESIRED_KMH, size=len(rows)) / 3.6
            gaps = np.append(np.diff(ahead), self._length - ahead[-1:]) - SIZE[0]
            cars[rows, kernel.SPEED] = self._starting_speed(cars[rows], gaps)
        cars[:, kernel.Y_FROM] = cars[:, kernel.Y_TO] = cars[:, kernel.Y]
        cars[:, kernel.DONE] = 1.0
        # Not all at once: the first lane changes come when each has settled.
        cars[:, kernel.REST_S] = rng.uniform(0.0, kernel.REST_BETWEEN_CHANGES_S, size=count)
        return cars

    def _starting_speed(self, cars: FloatArray, gaps: FloatArray) -> FloatArray:
        """Slow enough for the bend, to keep the distance, and to stop behind a car at rest."""
        cells = len(self._limit)
        cell = (cars[:, kernel.S] / self._length * cells).astype(int) % cells
        free = np.maximum(gaps - STANDSTILL_GAP_M, 0.0)
        keeping = np.minimum(free / TIME_HEADWAY_S, np.sqrt(2 * COMFORTABLE_BRAKING * free))
        speed: FloatArray = np.minimum(cars[:, kernel.DESIRED], self._limit[cell])
        return np.minimum(speed, keeping)


def _spread(count: int, reach: float, rng: np.random.Generator) -> FloatArray:
    """(count,) places in [0, reach], rising, one in each of `count` equal parts."""
    part = reach / max(count, 1)
    return part * np.arange(count) + rng.uniform(0.0, max(part - _LEAST_SPACING_M, 0.0), count)


def _bends(track: Track, outermost_y: float) -> FloatArray:
    """Speed limit (m/s) of cells of about 1 m around the loop.

    The limit is that of the innermost lane and falls before a bend at a comfortable braking.
    """
    cells = math.ceil(track.length_m / _CELL_M)
    step = track.length_m / cells
    curvature = track.at((np.arange(cells) + 0.5) * step).curvature
    sharpness = np.abs(curvature)
    innermost = sharpness / np.maximum(1.0 - sharpness * outermost_y, 0.1)
    squared = SIDE_ACCELERATION / np.maximum(innermost, 1e-6)
    kernel.brake_ahead(squared, 2 * COMFORTABLE_BRAKING * step)
    limit: FloatArray = np.sqrt(squared)
    return limit
