"""Checks of the traffic at every step of a long drive: overlaps, lanes, speeds, jumps.

The tests run it on a few roads, `benchmarks/traffic.py` on all of them.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from runtime.jit import compiled
from simulator.driving.cruise import Cruise
from simulator.track.road import Road
from simulator.traffic.traffic import DESIRED_KMH, EGO_CAR_SIZE, MAX_CARS, TRAFFIC_CAR_SIZE, Traffic
from simulator.vehicle.state import CarState, Command
from simulator.world.boxes import AXES, BOX, HALF, boxes_overlap
from simulator.world.world import World

FREQUENCY_HZ = 20
PARKED = Command(brake=1.0, gear=0)
FASTEST_SIDEWAYS_M_S = 3.0
ROUNDING_M = 1e-6


@dataclass(frozen=True)
class TrafficAudit:
    """Statistics of the traffic on one road."""

    steps: int
    lane_changes: int
    mean_speed_kmh: float
    stopped_at_end: int
    own_laps: int


class TrafficViolation(Exception):
    """A checked rule of the traffic is violated."""


def audit_traffic(
    road: Road, seconds: float, *, parked: bool = False, seed: int = 0
) -> TrafficAudit:
    """Drive MAX_CARS cars for `seconds`, with the ego car among them: it drives by the same model
    or is parked.

    Raises TrafficViolation when two cars overlap, or one leaves its lanes, jumps, or exceeds its
    speed range.
    """
    driver = Cruise(road, speed_kmh=70.0, frequency_hz=FREQUENCY_HZ)
    steps, changes, driven = round(seconds * FREQUENCY_HZ), 0, 0.0
    with World(road, traffic=MAX_CARS, frequency_hz=FREQUENCY_HZ) as world:
        lane_y = 0.5 * (road.markings_y[-1] + road.markings_y[-2])
        state = world.reset(seed=seed, to_middle=float(lane_y))
        before = _Moment(world.traffic)
        for _ in range(steps):
            command = PARKED if parked else driver.command(state, world.traffic)
            state = world.step(command)
            now = _Moment(world.traffic)
            _check(road, state, before, now)
            changes += int(np.count_nonzero(now.lane(road) != before.lane(road)))
            driven += float(now.speed.sum())
            before = now
        mean = 3.6 * driven / (steps * MAX_CARS)
        stopped = int(np.count_nonzero(before.speed < 0.1))
        return TrafficAudit(steps, changes, mean, stopped, state.lap)


class _Moment:
    """Positions and speeds of the traffic at one time."""

    def __init__(self, traffic: Traffic) -> None:
        self.poses, self.s = traffic.poses(), traffic.s
        self.to_middle, self.speed = traffic.to_middle, traffic.speed

    def lane(self, road: Road) -> NDArray[np.int64]:
        """(n,) index of the lane that each car's centre is in."""
        return np.searchsorted(-road.markings_y, -self.to_middle)


def _check(road: Road, state: CarState, before: _Moment, now: _Moment) -> None:
    if state.collision is not None:
        raise TrafficViolation(f"the ego car hit {state.collision} at {state.time_s:.2f} s")
    boxes = np.empty((len(now.s) + 1, 5))
    boxes[:-1, :2], boxes[:-1, 2], boxes[:-1, 3:] = (
        now.poses[:, :2],
        now.poses[:, 5],
        TRAFFIC_CAR_SIZE[:2],
    )
    boxes[-1] = (state.x, state.y, state.yaw, *EGO_CAR_SIZE[:2])
    pair = first_overlap(boxes)
    if pair[0] >= 0:
        raise TrafficViolation(f"cars {pair} overlap at {state.time_s:.2f} s")
    if np.any(np.abs(now.to_middle) + 0.5 * TRAFFIC_CAR_SIZE[1] > road.markings_y[0]):
        raise TrafficViolation(f"a car is off the lanes at {state.time_s:.2f} s")
    if np.any(now.speed < 0.0) or np.any(3.6 * now.speed > DESIRED_KMH[1] + ROUNDING_M):
        raise TrafficViolation(f"a speed is out of bounds at {state.time_s:.2f} s")
    dt, length = 1.0 / FREQUENCY_HZ, road.track.length_m
    forward = (now.s - before.s + 0.5 * length) % length - 0.5 * length
    way = np.hypot(*(now.poses[:, :2] - before.poses[:, :2]).T)
    sideways = np.abs(now.to_middle - before.to_middle)
    most = np.maximum(now.speed, before.speed) * dt
    # A car that changes lanes moves a little farther than its speed along the lane gives.
    if np.any(way > np.hypot(most, sideways) + 0.02) or np.any(forward < -ROUNDING_M):
        raise TrafficViolation(f"a car jumped at {state.time_s:.2f} s")
    if np.any(sideways > FASTEST_SIDEWAYS_M_S * dt):
        raise TrafficViolation(f"a car slid sideways at {state.time_s:.2f} s")
    if not math.isfinite(float(now.poses.sum())):
        raise TrafficViolation(f"a position is not finite at {state.time_s:.2f} s")


@compiled
def rectangles_overlap(a: NDArray[np.float64], b: NDArray[np.float64]) -> bool:
    """Whether two rectangles (x, y, yaw, length, width) overlap."""
    both = np.zeros((2, BOX))
    for row, rectangle in enumerate((a, b)):
        cos, sin = math.cos(rectangle[2]), math.sin(rectangle[2])
        both[row, 0], both[row, 1] = rectangle[0], rectangle[1]
        both[row, AXES], both[row, AXES + 1] = cos, sin
        both[row, AXES + 3], both[row, AXES + 4] = -sin, cos
        both[row, AXES + 8] = 1.0
        both[row, HALF], both[row, HALF + 1] = 0.5 * rectangle[3], 0.5 * rectangle[4]
        both[row, HALF + 2] = 1.0
    return boxes_overlap(both[0], both[1], 0.0)


@compiled
def first_overlap(boxes: NDArray[np.float64]) -> tuple[int, int]:
    """Indices of the first pair of `boxes` (n, 5) that overlap, (-1, -1) if none do."""
    for i in range(boxes.shape[0]):
        for j in range(i + 1, boxes.shape[0]):
            reach = boxes[i, 3] + boxes[j, 3]
            near = abs(boxes[i, 0] - boxes[j, 0]) < reach and abs(boxes[i, 1] - boxes[j, 1]) < reach
            if near and rectangles_overlap(boxes[i], boxes[j]):
                return i, j
    return -1, -1
