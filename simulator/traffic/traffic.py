"""Traffic: up to twelve cars in lanes that follow the intelligent driver model.

Cars drive at 40 to 62 km/h, slow down for bends, and change lanes if both gaps are safe and they
gain acceleration. They treat the ego car as a leader or follower like any traffic car. Track frame:
s along the centre line, to_middle left positive, m and m/s.
"""

import math

import numpy as np
from numpy.typing import NDArray

from simulator.arrays import FloatArray
from simulator.track.geometry import Track
from simulator.track.road import START_BEFORE_LINE_M, Road
from simulator.traffic import car_table
from simulator.traffic.idm import COMFORTABLE_BRAKING, STANDSTILL_GAP_M, TIME_HEADWAY_S
from simulator.traffic.wreck import TRAFFIC_CAR
from simulator.vehicle.car import CarParameters
from trackfeatures.errors import UserError

TRAFFIC_CAR_SIZE = (TRAFFIC_CAR.length, TRAFFIC_CAR.width, TRAFFIC_CAR.height)
"""Length, width and height of a traffic car (m)."""
EGO_CAR_SIZE = (CarParameters.length, CarParameters.width, CarParameters.height)
MAX_CARS = 12
DESIRED_KMH = (40.0, 62.0)
MIN_START_GAP_M = 25.0
"""Least gap (m, bumper to bumper) between the ego car and any traffic car at the start."""
START_RANGE_M = 600.0
"""Traffic cars start within this distance (m) ahead of the ego car, or within a longer distance if
there are many cars."""
LATERAL_ACCELERATION = 3.0
"""Largest lateral acceleration (m/s2) of a car in a bend."""

_PER_CAR_M = 50.0  # least length of the start range divided by the number of cars
_MIN_SPACING_M = TRAFFIC_CAR_SIZE[0] + 12.0
# least distance between the middles of the ego car and of a traffic car at the start
_NEAREST_M = MIN_START_GAP_M + 0.5 * (TRAFFIC_CAR_SIZE[0] + EGO_CAR_SIZE[0])
_CELL_M = 1.0


def most_cars(length_m: float, lanes: int) -> int:
    """Return the largest number of traffic cars that fit on a road of `length_m` with `lanes`
    lanes; 0 if the road has no room."""
    room = length_m - 2 * _NEAREST_M
    return min(lanes * max(int(room / _MIN_SPACING_M), 0), MAX_CARS)


class Traffic:
    """`count` cars on `road`. Their start is random from `rng`; their driving is deterministic.

    `ego_s` is the start of the ego car (m, default: 25 m before the start line). Raises UserError
    if the road has no room for `count` cars.
    """

    def __init__(
        self, road: Road, count: int, rng: np.random.Generator, *, ego_s: float | None = None
    ) -> None:
        self.road = road
        self.count = count
        self._length = road.track.length_m
        self._table = road.track.arrays()
        markings = road.markings_y
        self._lane_y = 0.5 * (markings[:-1] + markings[1:])
        start = self._length - START_BEFORE_LINE_M if ego_s is None else ego_s
        self._limit = (
            _curve_speed_limits(road.track, float(np.max(self._lane_y))) if count else np.zeros(1)
        )
        self._cars = self._initial_cars(count, rng, start % self._length)
        self._bodies = np.zeros((count + 1, car_table.BODY_COLUMNS))
        self._poses = np.zeros((count, 6))
        self._update_ego(start % self._length, 0.0, 0.0)
        self._update_bodies()

    @property
    def s(self) -> FloatArray:
        """Position (n,) of the cars' centres along the centre line, m."""
        return self._cars[:, car_table.S].copy()

    @property
    def to_middle(self) -> FloatArray:
        """Lateral offset (n,) of the cars from the centre line, m, left positive."""
        return self._cars[:, car_table.Y].copy()

    @property
    def speed(self) -> FloatArray:
        """Speed (n,) of the cars along their lanes, m/s."""
        return self._cars[:, car_table.SPEED].copy()

    @property
    def desired_speed(self) -> FloatArray:
        """Speed (n,) that each car would drive on a free, straight road, m/s."""
        return self._cars[:, car_table.DESIRED].copy()

    def poses(self) -> FloatArray:
        """Return the poses (n, 6) of the ground points under the cars: x, y, z (m), roll, pitch,
        yaw (rad) in the world frame."""
        return self._poses.copy()

    def step(self, dt: float, ego_s: float, ego_to_middle: float, ego_speed: float) -> None:
        """Advance all cars by `dt` s; ego_s and ego_to_middle in m, ego_speed in m/s."""
        if self.count == 0:
            return
        self._update_ego(ego_s, ego_to_middle, ego_speed)
        car_table.step_traffic(
            self._cars,
            self._bodies,
            dt,
            self._length,
            self._lane_y,
            self._table,
            self._limit,
            0.5 * TRAFFIC_CAR_SIZE[0],
            0.5 * TRAFFIC_CAR_SIZE[1],
        )
        car_table.update_poses(self._cars, self._table, self._poses)

    @property
    def struck(self) -> NDArray[np.bool_]:
        """Whether each car was hit (n,). Struck cars are obstacles that physics moves."""
        return self._cars[:, car_table.STRUCK] > 0.0

    def mark_struck(self, row: int) -> None:
        """Remove car `row` from lane driving; from then on `set_struck_pose` moves it."""
        self._cars[row, car_table.STRUCK] = 1.0
        self._cars[row, car_table.CHANGE_PROGRESS] = 1.0

    def set_struck_pose(self, row: int, pose: FloatArray, track_state: FloatArray) -> None:
        """Set the pose (6,) of the struck car `row`: x, y, z, roll, pitch, yaw of the ground point
        under it. `track_state` (4,) is s, to_middle, angle (m, rad) and the speed along the track
        (m/s). Other cars avoid the car's bounding box in the track frame."""
        s, to_middle, angle, speed = track_state
        cos, sin = abs(math.cos(angle)), abs(math.sin(angle))
        half_length = 0.5 * (TRAFFIC_CAR_SIZE[0] * cos + TRAFFIC_CAR_SIZE[1] * sin)
        half_width = 0.5 * (TRAFFIC_CAR_SIZE[0] * sin + TRAFFIC_CAR_SIZE[1] * cos)
        self._poses[row] = pose
        self._cars[row, [car_table.S, car_table.Y, car_table.SPEED]] = s, to_middle, speed
        left, right = to_middle + half_width, to_middle - half_width
        forward = max(speed, 0.0)
        self._bodies[row] = (s, right, left, forward, half_length, max(forward, 1.0))

    def leader(self, s: float, to_middle: float) -> tuple[float, float] | None:
        """Return bumper gap (m) and speed (m/s) of the nearest car ahead in the path of a car of
        the ego car's size at (`s`, `to_middle`), or None."""
        half = 0.5 * EGO_CAR_SIZE[1]
        row, gap = car_table.nearest_body(
            self._bodies[: self.count],
            -1,
            s,
            to_middle - half,
            to_middle + half,
            0.5 * EGO_CAR_SIZE[0],
            self._length,
            True,
        )
        return None if row < 0 else (float(gap), float(self._bodies[row, car_table.B_SPEED]))

    def has_room(self, s: float, to_middle: float, speed: float) -> bool:
        """Return whether the ego car at `s` (m) with `speed` (m/s) can move to the lateral position
        `to_middle` (m) with safe gaps to the car ahead and to the car behind it there."""
        half = 0.5 * EGO_CAR_SIZE[1]
        safe, _ = car_table.lane_change_safe(
            self._bodies,
            self.count,
            s,
            speed,
            to_middle - half,
            to_middle + half,
            0.5 * EGO_CAR_SIZE[0],
            self._length,
        )
        return bool(safe)

    def _update_ego(self, s: float, to_middle: float, speed: float) -> None:
        """Write the ego car's extent and speed into the last row of the bodies."""
        half = 0.5 * EGO_CAR_SIZE[1]
        # The desired speed of the ego car is unknown; its current speed is used instead.
        self._bodies[self.count] = (
            s % self._length,
            to_middle - half,
            to_middle + half,
            speed,
            0.5 * EGO_CAR_SIZE[0],
            max(speed, 1.0),
        )

    def _update_bodies(self) -> None:
        car_table.update_bodies(
            self._cars, self._bodies, 0.5 * TRAFFIC_CAR_SIZE[0], 0.5 * TRAFFIC_CAR_SIZE[1]
        )
        car_table.update_poses(self._cars, self._table, self._poses)

    def _initial_cars(self, count: int, rng: np.random.Generator, ego_s: float) -> FloatArray:
        """Return a table of `count` random cars ahead of `ego_s` (m), the start of the ego car.
        Raises UserError if there is no room."""
        room = self._length - 2 * _NEAREST_M
        lanes = len(self._lane_y)
        if not isinstance(count, int | np.integer) or isinstance(count, bool):
            raise UserError(f"the number of traffic cars is {count!r}; give a whole number")
        fits = most_cars(self._length, lanes)
        if not 0 <= count <= fits:
            raise UserError(
                f"{count} traffic cars asked for, but {self.road.track.name!r} with {lanes} "
                f"lane(s) takes 0 to {fits}; ask for fewer"
            )
        cars = np.zeros((count, car_table.CAR_COLUMNS))
        lane = rng.permutation(np.arange(count) % lanes)
        reach = min(room, max(START_RANGE_M, _PER_CAR_M * count))
        for number in range(lanes):
            rows = np.flatnonzero(lane == number)
            ahead = _NEAREST_M + _random_places(len(rows), reach, rng)
            cars[rows, car_table.S] = (ego_s + ahead) % self._length
            cars[rows, car_table.Y] = self._lane_y[number]
            cars[rows, car_table.DESIRED] = rng.uniform(*DESIRED_KMH, size=len(rows)) / 3.6
            gaps = np.append(np.diff(ahead), self._length - ahead[-1:]) - TRAFFIC_CAR_SIZE[0]
            cars[rows, car_table.SPEED] = self._initial_speed(cars[rows], gaps)
        cars[:, car_table.Y_FROM] = cars[:, car_table.Y_TO] = cars[:, car_table.Y]
        cars[:, car_table.CHANGE_PROGRESS] = 1.0
        # The cooldowns differ, so that the first lane changes are not simultaneous.
        cars[:, car_table.COOLDOWN_S] = rng.uniform(0.0, car_table.CHANGE_COOLDOWN_S, size=count)
        return cars

    def _initial_speed(self, cars: FloatArray, gaps: FloatArray) -> FloatArray:
        """Return start speeds (n,) in m/s of `cars`. They keep the speed limit and the time
        headway, and from them each car can stop behind a leader at rest. `gaps` (n,) are the bumper
        gaps (m) to the leaders."""
        cells = len(self._limit)
        cell = (cars[:, car_table.S] / self._length * cells).astype(int) % cells
        free = np.maximum(gaps - STANDSTILL_GAP_M, 0.0)
        keeping = np.minimum(free / TIME_HEADWAY_S, np.sqrt(2 * COMFORTABLE_BRAKING * free))
        speed: FloatArray = np.minimum(cars[:, car_table.DESIRED], self._limit[cell])
        return np.minimum(speed, keeping)


def _random_places(count: int, reach: float, rng: np.random.Generator) -> FloatArray:
    """Return ascending random positions (count,) in [0, reach], one in each of `count` parts."""
    part = reach / max(count, 1)
    return part * np.arange(count) + rng.uniform(0.0, max(part - _MIN_SPACING_M, 0.0), count)


def _curve_speed_limits(track: Track, outermost_y: float) -> FloatArray:
    """Return speed limits (cells,) in m/s, in cells of about 1 m around the loop.

    The limit is the limit of the innermost lane, whose centre is `outermost_y` (m) from the centre
    line. Before a bend it decreases at comfortable braking.
    """
    cells = math.ceil(track.length_m / _CELL_M)
    step = track.length_m / cells
    curvature = track.at((np.arange(cells) + 0.5) * step).curvature
    sharpness = np.abs(curvature)
    innermost = sharpness / np.maximum(1.0 - sharpness * outermost_y, 0.1)
    squared = LATERAL_ACCELERATION / np.maximum(innermost, 1e-6)
    car_table.limit_deceleration(squared, 2 * COMFORTABLE_BRAKING * step)
    limit: FloatArray = np.sqrt(squared)
    return limit
