"""The scripted driver: it follows a course (an offset from the track's centre for each metre
driven), keeps a distance to the car ahead and overtakes slow cars.

`simulator.driving.lateral_law` computes the steering along the course. Track frame, left positive.
"""

from math import atan
from typing import Protocol

import trackfeatures as tf
from datagen.driving.trajectory import Course, max_offset
from simulator.driving.lateral_law import MIN_SPEED, PREVIEW_S, LateralLaw, feedback_speed
from simulator.driving.speed import SpeedControl, speed_profile
from simulator.track.road import Road
from simulator.traffic.traffic import EGO_CAR_SIZE, TRAFFIC_CAR_SIZE, Traffic
from simulator.vehicle.car import CarParameters
from simulator.vehicle.state import CarState, Command

NATURAL_FREQUENCY = 2.2  # rad/s: natural frequency of the controlled lateral motion
DAMPING = 0.85
MAX_LATERAL_SPEED = 2.4  # m/s: largest speed at which the target offset changes
MAX_PATH_ANGLE = 0.16  # rad: largest angle between the path and the road
LANE_CHANGE_SPEED = 1.4  # m/s: largest lateral speed of a lane change
LANE_CHANGE_RESPONSE = 1.0  # 1/s: lateral speed (m/s) per metre that the lane change still needs
PASSING_DISTANCE_M = 2.4  # least lateral distance between the centres of cars side by side
LANE_CHANGE_PAUSE_S = 4.0  # least time between the starts of two lane changes
SLOWER_BY = 1.5  # m/s: a car ahead is overtaken if it is slower than the target speed by this much


class SteeringLaw(Protocol):
    """Converts the driver's path into steering; `LateralLaw` is the default."""

    def road_curvature(self, state: CarState) -> float:
        """Return the curvature (1/m, left positive) of a path parallel to the road through the car,
        taken where the car will be after a short preview time."""

    def steer(
        self, state: CarState, offset: float, curvature: float, path_angle: float = 0.0
    ) -> float:
        """Return the steering action in [-1, 1], left positive, to follow a path at `offset` (m
        from the track's centre, left positive) with `curvature` (1/m) and `path_angle` (rad) to the
        road."""

    def restart(self) -> None:
        """Clear the state of the law, because the car was put back onto the road."""


class ScriptedDriver:
    """The driver of one round. It uses no random numbers, so the same round gets the same
    commands."""

    def __init__(
        self,
        road: Road,
        course: Course,
        speed: float,
        frequency_hz: int = 20,
        *,
        law: SteeringLaw | None = None,
    ) -> None:
        """Drive along `course` at `speed` (m/s) where road and traffic allow it.

        `frequency_hz` is the number of calls of `command` per simulated second. `law` computes the
        steering in place of `LateralLaw`.
        """
        car = CarParameters()
        self._road = road
        self._course = course
        self._dt = 1.0 / frequency_hz
        self._max_offset = max_offset(road)
        self._law = law or LateralLaw(
            car, road, natural_frequency=NATURAL_FREQUENCY, damping=DAMPING
        )
        self._profile = speed_profile(road.track, speed, self._max_offset)
        self._speed_control = SpeedControl(self._profile, road.track, car, self._dt)
        self.restart()

    def restart(self) -> None:
        """Clear the state of the controllers. The course continues where it was."""
        self._speed_control.reset()
        self._law.restart()
        self._shift = 0.0  # m: lane change, added to the course's offset
        self._shift_target = 0.0
        self._pause_s = 0.0
        self._steered_for: float | None = None

    def offset_at(self, driven_m: float) -> float:
        """Return the course's offset from the track's centre (m, left positive) after `driven_m`
        metres of the round."""
        return self._course.at(driven_m)[0]

    def speed_at(self, s: float) -> float:
        """Return the target speed in m/s at the position `s` (m) on the lap."""
        return self._profile.at(s)

    def command(self, state: CarState, traffic: Traffic, driven_m: float) -> Command:
        """Return steering, throttle, brake and gear for one control step. `driven_m` is the
        distance (m) driven since the start of the round; resets of the car onto the road do not
        reduce it."""
        if traffic.count:
            self._choose_lane(state, traffic, driven_m)
        shift_speed = self._step_shift()
        steer = self._steer(state, traffic, driven_m, shift_speed)
        throttle, brake, gear = self._speed_control.command(state, traffic)
        return Command(steer=steer, throttle=throttle, brake=brake, gear=gear)

    def _steer(
        self, state: CarState, traffic: Traffic, driven_m: float, shift_speed: float
    ) -> float:
        v = feedback_speed(state)
        offset, slope, course_curvature = self._course.at(driven_m + v * PREVIEW_S)
        wanted, free = self._avoid_cars(offset + self._shift, state, traffic)
        target = self._limit_lateral_speed(wanted, state.to_middle)
        slope = min(max(slope + shift_speed / v, -MAX_PATH_ANGLE), MAX_PATH_ANGLE) if free else 0.0
        curvature = self._law.road_curvature(state) + (course_curvature if free else 0.0)
        return self._law.steer(state, target, curvature, atan(slope))

    def _limit_lateral_speed(self, wanted: float, to_middle: float) -> float:
        """Move the target offset (m) towards `wanted` (m) for one control step, by at most
        `MAX_LATERAL_SPEED` times the duration of the step. Return the new target offset. In the
        first control step, it starts from `to_middle` (m)."""
        before = to_middle if self._steered_for is None else self._steered_for
        most = MAX_LATERAL_SPEED * self._dt
        self._steered_for = min(max(wanted, before - most), before + most)
        return self._steered_for

    def _choose_lane(self, state: CarState, traffic: Traffic, driven_m: float) -> None:
        """Start a lane change when the car ahead is slow and a neighbouring lane is free. Return to
        the course's lane when no car is close ahead. `driven_m` is the distance (m) driven since
        the start of the round."""
        self._pause_s = max(self._pause_s - self._dt, 0.0)
        road = self._road
        leader = traffic.leader(state.s, state.to_middle)
        if self._pause_s > 0.0 or road.lanes == 1:
            return
        offset = self._course.at(driven_m)[0]
        if leader is None or leader[0] > 3.0 * max(state.speed, MIN_SPEED):
            if self._shift_target and traffic.has_room(state.s, offset, state.speed):
                self._shift_target, self._pause_s = 0.0, LANE_CHANGE_PAUSE_S
            return
        if leader[1] > self._profile.at(state.s) - SLOWER_BY:
            return
        lane = tf.lane_index(state.to_middle, road.lanes, road.lane_width)
        for other in (lane - 1, lane + 1):
            if not 0 <= other < road.lanes:
                continue
            centre = tf.lane_centre(other, road.lanes, road.lane_width)
            if traffic.has_room(state.s, centre, state.speed):
                self._shift_target, self._pause_s = centre - offset, LANE_CHANGE_PAUSE_S
                return

    def _step_shift(self) -> float:
        """Move the car's shift from its course by one control step; return the shift's speed (m/s,
        left positive)."""
        speed = LANE_CHANGE_RESPONSE * (self._shift_target - self._shift)
        speed = min(max(speed, -LANE_CHANGE_SPEED), LANE_CHANGE_SPEED)
        self._shift += speed * self._dt
        return speed

    def _avoid_cars(self, wanted: float, state: CarState, traffic: Traffic) -> tuple[float, bool]:
        """Limit the offset `wanted` (m) to the part of the road without cars alongside. Returns the
        limited offset, and whether `wanted` lies in this part of the road."""
        low, high = -self._max_offset, self._max_offset
        length = self._road.track.length_m
        near = 0.5 * (TRAFFIC_CAR_SIZE[0] + EGO_CAR_SIZE[0]) + 2.0 + 0.4 * max(state.speed, 0.0)
        for s, y in zip(traffic.s.tolist(), traffic.to_middle.tolist(), strict=True):
            ahead = (s - state.s + 0.5 * length) % length - 0.5 * length
            # For a car ahead in the same lane the driver brakes; it does not steer away.
            if abs(ahead) > near or abs(y - state.to_middle) < 0.5 * PASSING_DISTANCE_M:
                continue
            if y > state.to_middle:
                high = min(high, y - PASSING_DISTANCE_M)
            else:
                low = max(low, y + PASSING_DISTANCE_M)
        if low > high:
            return 0.5 * (low + high), False
        return min(max(wanted, low), high), low <= wanted <= high
