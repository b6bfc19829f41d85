"""Driving at a set speed (`controllers drive --speed`): slower in bends, at a distance to traffic.

The law of the scripted drivers (`simulator.driving.speed`) presses the pedals: proportional, with a
bounded integral, on the inverse model of engine, drag and slope, gears by engine speed; IDM behind
a leader. Here it gets the speed that the road allows: on the truth from the curvature ahead, on
perception from what a car can tell itself. SI units, left positive.
"""

import math
from collections.abc import Callable

from controllers.interface import Observation
from controllers.lqr import CurvatureEstimate
from controllers.perception import Perceived
from simulator.driving.speed import LATERAL_ACCELERATION, PREVIEW_S, TargetSpeed, speed_profile
from simulator.track.road import Road
from simulator.traffic.traffic import Traffic
from simulator.vehicle.car import CarParameters
from simulator.vehicle.state import CarState
from trackfeatures import RoadClass
from trackfeatures.errors import UserError

SLOWEST, FASTEST = 1.0, 40.0
"""Limits of a set-point (m/s): in fourth gear, the highest that is used, the car reaches 50."""
SETTLED_S, GAINING = 4.0, 1.5
"""The error counts when the road has been free for so many seconds and for the time to reach the
set-point at so many m/s2: then the car should be at its set-point."""
NEW_BEND_RADIUS_M = 60.0
"""Of a bend that is announced by the class of the road and not yet felt: a cautious guess ..."""
NEW_BEND_S = 2.0
"""... for this long. Then the curvature felt decides."""
CLASS_FILTER_S = 0.15
"""Time constant of the filter on the class: a single wrong answer does not brake."""

AllowedSpeed = Callable[[CarState, Perceived], float]
"""The speed (m/s) that the road allows; inf without a limit."""


class SpeedHold:
    """Pedals that hold `speed` m/s; called once a control step of `dt` s.

    Raises UserError for a speed out of range.
    """

    def __init__(
        self,
        speed: float,
        dt: float,
        allowed: AllowedSpeed,
        slope: Callable[[CarState], float],
        car: CarParameters | None = None,
    ) -> None:
        if not SLOWEST <= speed <= FASTEST:
            raise UserError(
                f"a speed of {speed:g} m/s is out of range; give {SLOWEST:g} to {FASTEST:g}"
            )
        self._speed, self._dt, self._allowed, self._slope = speed, dt, allowed, slope
        self._target = TargetSpeed(car or CarParameters(), dt)
        self._settled_in_s = SETTLED_S + speed / GAINING
        self._errors: list[float] = []

    def __call__(
        self, now: CarState, traffic: Traffic, perceived: Perceived
    ) -> tuple[float, float, int]:
        """Throttle, brake and gear."""
        target = min(self._speed, self._allowed(now, perceived))
        pressed = self._target.command(now, traffic, target, self._slope(now))
        free = target == self._speed and not self._target.following
        error = abs(now.speed - self._speed)
        self._settled_in_s = self._settled_in_s - self._dt if free else SETTLED_S + error / GAINING
        if self._settled_in_s < 0.0:
            self._errors.append(error)
        return pressed

    @property
    def mean_error(self) -> float | None:
        """m/s from the set-point on free straights; None where there was none."""
        return sum(self._errors) / len(self._errors) if self._errors else None


def on_the_truth(speed: float, road: Road, lane_centre: float, dt: float) -> SpeedHold:
    """Slows before bends, whose curvature is known, along `lane_centre` (m left of the centre)."""
    profile = speed_profile(road.track, speed, abs(lane_centre))

    def allowed(now: CarState, perceived: Perceived) -> float:
        return profile.at(now.s + PREVIEW_S * max(now.speed, 0.0))

    return SpeedHold(speed, dt, allowed, lambda now: road.track.slope(now.s))


def on_perception(speed: float, dt: float) -> SpeedHold:
    """Slows down in bends, which the car's yaw rate and the perceived road class show.

    The slope is that of the body: an inclination sensor.
    """
    return SpeedHold(speed, dt, CornerSpeed(dt), lambda now: math.tan(-now.pitch))


class CornerSpeed:
    """The speed limit (m/s) in bends, from the perceived road class and the car's yaw rate."""

    def __init__(self, dt: float) -> None:
        self._dt = dt
        self._curvature = CurvatureEstimate(dt)
        self._turn = 0.0
        """Class of the road, left 1, right -1, low-pass filtered."""
        self._side = 0
        self._bend_s = math.inf
        """Since a bend was announced."""

    def __call__(self, now: CarState, perceived: Perceived) -> float:
        turn = {RoadClass.LEFT: 1, RoadClass.STRAIGHT: 0, RoadClass.RIGHT: -1}[perceived.heading]
        self._turn += self._dt / (self._dt + CLASS_FILTER_S) * (turn - self._turn)
        side = round(self._turn)
        self._bend_s = 0.0 if side not in (0, self._side) else self._bend_s + self._dt
        self._side = side
        felt = Observation(0.0, 0.0, perceived.heading, now.vx, now.vy, now.yaw_rate)
        curvature = abs(self._curvature(felt))
        if side and self._bend_s < NEW_BEND_S:
            curvature = max(curvature, 1.0 / NEW_BEND_RADIUS_M)
        return math.sqrt(LATERAL_ACCELERATION / max(curvature, 1e-6))
