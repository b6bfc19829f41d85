"""The scripted driver: follows its round's course, keeps its distance, overtakes where it can.

Steering is state feedback with preview on the bicycle model (Rajamani, Vehicle Dynamics and
Control, 2.5): errors are taken to the course, gains scale with speed so that the answer is alike.
Track frame, left positive; `angle` is track tangent minus yaw.
"""

from math import atan, inf

import numpy as np

import trackfeatures as tf
from datagen.driving.trajectory import Course, reach
from simulator.driving.speed import BRAKING, Pedals, speed_profile, wanted_acceleration
from simulator.track.road import Road
from simulator.traffic.idm import idm_acceleration
from simulator.traffic.traffic import EGO_CAR_SIZE, TRAFFIC_CAR_SIZE, Traffic
from simulator.vehicle.car import CarParameters
from simulator.vehicle.state import CarState, Command
from simulator.vehicle.surface import SURFACES

NATURAL_FREQUENCY = 2.2  # rad/s of the lateral motion
DAMPING = 0.85
YAW_RATE_GAIN = 0.08  # s
LEAST_SPEED = 5.0  # m/s: below, the gains would grow without bound
PREVIEW_S = 0.12  # about what steering rate and the control step cost
FASTEST_SIDEWAYS = 2.4  # m/s
STEEPEST = 0.16  # rad to the road that the driver asks for
FASTEST_SHIFT = 1.4  # m/s sideways while changing lanes
SHIFT_RESPONSE = 1.0  # 1/s
BESIDE_M = 2.4  # between the middles of cars that pass each other
HOLD_LANE_S = 4.0
SLOWER_BY = 1.5  # m/s: a leader this much slower is worth a lane change


class ScriptedDriver:
    """One round's driver. Deterministic: everything random is in the course."""

    def __init__(
        self,
        road: Road,
        course: Course,
        speed: float,
        frequency_hz: int = 20,
        car: CarParameters | None = None,
    ) -> None:
        self._road = road
        self._course = course
        self._car = car or CarParameters()
        grip = SURFACES[road.track.surface].grip
        self._rear_stiffness = self._car.cornering_stiffness(False, grip)
        self._pedals = Pedals(self._car)
        self._dt = 1.0 / frequency_hz
        self._reach = reach(road)
        self._profile = speed_profile(road.track, speed, self._reach)
        self.restart()

    def restart(self) -> None:
        """Forget what belongs to the moment; the course goes on where it was."""
        self._pedals.reset()
        self._shift = 0.0
        self._shift_target = 0.0
        self._hold = 0.0
        self._place: float | None = None

    def offset_at(self, driven_m: float) -> float:
        return self._course.at(driven_m)[0]

    def speed_at(self, s: float) -> float:
        """m/s that the driver wants at `s`."""
        return self._profile.at(s)

    @property
    def place(self) -> float:
        """Lateral place (m) that the last command steered for."""
        return self._place or 0.0

    def command(self, state: CarState, traffic: Traffic, driven_m: float) -> Command:
        """`driven_m` counts the whole round, over its resets too."""
        if traffic.count:
            self._choose_lane(state, traffic, driven_m)
        rate = self._move_shift()
        steer = self._steer(state, traffic, driven_m, rate)
        throttle, brake, gear = self._drive(state, traffic)
        return Command(steer=steer, throttle=throttle, brake=brake, gear=gear)

    def _steer(self, state: CarState, traffic: Traffic, driven_m: float, rate: float) -> float:
        car, v = self._car, max(state.speed, LEAST_SPEED)
        offset, slope, bend = self._course.at(driven_m + v * PREVIEW_S)
        wanted, free = self._clear(offset + self._shift, state, traffic)
        wanted = self._approach(wanted, state.to_middle)
        slope = min(max(slope + rate / v, -STEEPEST), STEEPEST) if free else 0.0
        kappa = float(self._road.track.curvature(state.s + v * PREVIEW_S))
        kappa = kappa / max(1.0 - kappa * state.to_middle, 0.3) + (bend if free else 0.0)
        # At speed the body stands askew in a bend: the slip of the centre of gravity.
        pressed = car.total_mass * car.front_axle * v * v / car.wheelbase
        slip = kappa * (car.rear_axle - pressed / (2.0 * self._rear_stiffness))
        off_course = state.to_middle - wanted
        off_heading = -state.angle - atan(slope) + slip
        gain = NATURAL_FREQUENCY**2 * car.wheelbase / (v * v)
        heading_gain = 2.0 * DAMPING * NATURAL_FREQUENCY * car.wheelbase / v
        wheel = (
            car.wheelbase * kappa
            - gain * float(np.clip(off_course, -1.5, 1.5))
            - heading_gain * off_heading
            - YAW_RATE_GAIN * (state.yaw_rate - v * kappa)
        )
        return min(max(wheel / car.steering_lock, -1.0), 1.0)

    def _approach(self, wanted: float, to_middle: float) -> float:
        """The place to steer for now: a sudden wish is met at a bounded sideways speed."""
        before = to_middle if self._place is None else self._place
        most = FASTEST_SIDEWAYS * self._dt
        self._place = min(max(wanted, before - most), before + most)
        return self._place

    def _drive(self, state: CarState, traffic: Traffic) -> tuple[float, float, int]:
        speed = max(state.speed, 0.0)
        target = self._profile.at(state.s + 0.5 * speed)
        pressed = inf
        leader = traffic.leader(state.s, state.to_middle) if traffic.count else None
        if leader is not None:
            pressed = float(idm_acceleration(leader[0], speed, leader[1], max(target, 1.0)))
        acceleration = wanted_acceleration(speed, target, pressed)
        # The trim is for a free road: behind a car, the wanted speed is not the target.
        error = target - speed if pressed > acceleration else 0.0
        error = error if abs(error) < BRAKING else 0.0
        slope = float(self._road.track.slope(state.s))
        return self._pedals.press(acceleration, speed, error, slope, self._dt)

    def _choose_lane(self, state: CarState, traffic: Traffic, driven_m: float) -> None:
        """Move one lane over when the car ahead is slow and the place beside is free."""
        self._hold = max(self._hold - self._dt, 0.0)
        road = self._road
        leader = traffic.leader(state.s, state.to_middle)
        if self._hold > 0.0 or road.lanes == 1:
            return
        offset = self._course.at(driven_m)[0]
        if leader is None or leader[0] > 3.0 * max(state.speed, LEAST_SPEED):
            if self._shift_target and traffic.has_room(state.s, offset, state.speed):
                self._shift_target, self._hold = 0.0, HOLD_LANE_S
            return
        if leader[1] > self._profile.at(state.s) - SLOWER_BY:
            return
        lane = tf.lane_index(state.to_middle, road.lanes, road.lane_width)
        for other in (lane - 1, lane + 1):
            if not 0 <= other < road.lanes:
                continue
            place = tf.lane_centre(other, road.lanes, road.lane_width)
            if traffic.has_room(state.s, place, state.speed):
                self._shift_target, self._hold = place - offset, HOLD_LANE_S
                return

    def _move_shift(self) -> float:
        """Sideways speed (m/s) of the lane change going on."""
        rate = SHIFT_RESPONSE * (self._shift_target - self._shift)
        rate = min(max(rate, -FASTEST_SHIFT), FASTEST_SHIFT)
        self._shift += rate * self._dt
        return rate

    def _clear(self, wanted: float, state: CarState, traffic: Traffic) -> tuple[float, bool]:
        """`wanted` kept on the road and away from cars alongside; False when it had to give way."""
        low, high = -self._reach, self._reach
        length = self._road.track.length_m
        near = 0.5 * (TRAFFIC_CAR_SIZE[0] + EGO_CAR_SIZE[0]) + 2.0 + 0.4 * max(state.speed, 0.0)
        for s, y in zip(traffic.s.tolist(), traffic.to_middle.tolist(), strict=True):
            ahead = (s - state.s + 0.5 * length) % length - 0.5 * length
            # A car in front in the same lane is kept off by the pedals, not by steering away.
            if abs(ahead) > near or abs(y - state.to_middle) < 0.5 * BESIDE_M:
                continue
            if y > state.to_middle:
                high = min(high, y - BESIDE_M)
            else:
                low = max(low, y + BESIDE_M)
        if low > high:
            return 0.5 * (low + high), False
        return min(max(wanted, low), high), low <= wanted <= high
