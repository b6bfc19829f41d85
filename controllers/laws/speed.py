"""Pedals that hold a set speed (`controllers drive --speed`) and slow down in bends and traffic.

The speed law of the scripted drivers (`simulator.driving.speed`) sets throttle, brake and gear.
This module limits the target speed of this law to the speed that the road allows. With exact states
the limit is computed from the curvature ahead, with a model's answers from the class of the road
and the car's yaw rate. SI units, left positive.
"""

import math
from collections.abc import Callable

from controllers.interface import Observation
from controllers.perception.curvature import CurvatureEstimate
from controllers.perception.perceived import Perceived
from simulator.driving.speed import LATERAL_ACCELERATION, PREVIEW_S, TargetSpeed, speed_profile
from simulator.track.road import Road
from simulator.traffic.traffic import Traffic
from simulator.vehicle.car import CarParameters
from simulator.vehicle.state import CarState
from trackfeatures import RoadClass
from trackfeatures.errors import UserError

SLOWEST, FASTEST = 1.0, 40.0
"""Lowest and highest set speed (m/s). The car reaches 50 m/s in fourth gear, the highest gear that
is used."""
SETTLED_S, GAINING = 4.0, 1.5
"""The speed error counts only after the road has been free for SETTLED_S (s) plus the time in which
the car reaches the set speed at an acceleration of GAINING (m/s2)."""
NEW_BEND_RADIUS_M, NEW_BEND_S = 60.0, 2.0
"""Assumed radius (m) of a bend for the first NEW_BEND_S (s) after the class of the road announces
the bend. From then on the curvature is estimated from the car's motion."""
CLASS_FILTER_S = 0.15
"""Time constant (s) of the low-pass filter on the class of the road. Because of the filter one
wrong answer has no effect."""

AllowedSpeed = Callable[[CarState, Perceived], float]
"""A function that returns the speed (m/s) that the road allows; inf for no limit."""


class SpeedHold:
    """Pedals that hold `speed` m/s; called once for each control step of `dt` s.

    `allowed` returns the speed (m/s) that the road allows, `slope` the slope of the road (rise over
    run). Raises UserError for a `speed` outside 1 to 40 m/s.
    """

    def __init__(
        self,
        speed: float,
        dt: float,
        allowed: AllowedSpeed,
        slope: Callable[[CarState], float],
    ) -> None:
        if not SLOWEST <= speed <= FASTEST:
            raise UserError(
                f"a speed of {speed:g} m/s is out of range; give {SLOWEST:g} to {FASTEST:g}"
            )
        self._speed, self._dt, self._allowed, self._slope = speed, dt, allowed, slope
        self._target = TargetSpeed(CarParameters(), dt)
        self._settled_in_s = SETTLED_S + speed / GAINING
        self._errors: list[float] = []

    def __call__(
        self, now: CarState, traffic: Traffic, perceived: Perceived
    ) -> tuple[float, float, int]:
        """Return throttle (0 to 1), brake (0 to 1) and gear for the present control step."""
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
        """Mean absolute speed error (m/s) while neither a bend nor traffic limited the speed,
        without the time that the car needs to reach the set speed; None if there was no such
        time."""
        return sum(self._errors) / len(self._errors) if self._errors else None


def on_the_truth(speed: float, road: Road, lane_centre: float, dt: float) -> SpeedHold:
    """Return pedals that hold `speed` m/s and brake before the bends of `road`.

    `lane_centre` is the line to follow, m left of the track's centre; `dt` is the control step (s).
    """
    profile = speed_profile(road.track, speed, abs(lane_centre))

    def allowed(now: CarState, perceived: Perceived) -> float:
        return profile.at(now.s + PREVIEW_S * max(now.speed, 0.0))

    return SpeedHold(speed, dt, allowed, lambda now: road.track.slope(now.s))


def on_perception(speed: float, dt: float) -> SpeedHold:
    """Return pedals that hold `speed` m/s and slow down in bends, which they detect by the yaw rate
    and the perceived class of the road.

    `dt` is the control step (s). The slope of the road is the pitch of the body, as an inclination
    sensor measures it.
    """
    return SpeedHold(speed, dt, CornerSpeed(dt), lambda now: math.tan(-now.pitch))


class CornerSpeed:
    """The speed limit (m/s) in bends, from the perceived class of the road and the yaw rate."""

    def __init__(self, dt: float) -> None:
        self._dt = dt
        self._curvature = CurvatureEstimate(dt)
        self._turn = 0.0
        """Class of the road (left 1, straight 0, right -1), low-pass filtered."""
        self._side = 0
        self._bend_s = math.inf
        """Time (s) since the class announced a bend."""

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
