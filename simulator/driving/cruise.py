"""A scripted driver that keeps its lane, slows down for bends, and keeps its distance to the car
ahead.

`lateral_law` computes the steering, `speed.SpeedControl` the pedals. Track frame, left positive.
"""

from typing import Final

import trackfeatures as tf
from simulator.driving.lateral_law import LateralLaw
from simulator.driving.speed import SpeedControl, speed_profile
from simulator.track.road import Road
from simulator.traffic.traffic import Traffic
from simulator.vehicle.car import CarParameters
from simulator.vehicle.state import CarState, Command

CRUISE_KMH: Final = 60.0
NATURAL_FREQUENCY: Final = 2.0  # rad/s: natural frequency of the controlled lateral motion
DAMPING: Final = 0.9


class Cruise:
    """Drives on `road` at up to `speed_kmh`, in the lane that is nearest at the first command."""

    def __init__(
        self,
        road: Road,
        *,
        speed_kmh: float = CRUISE_KMH,
        frequency_hz: int = 20,
        car: CarParameters | None = None,
    ) -> None:
        car = car or CarParameters()
        self._road = road
        self._law = LateralLaw(car, road, natural_frequency=NATURAL_FREQUENCY, damping=DAMPING)
        innermost = abs(tf.lane_centre(0, road.lanes, road.lane_width))
        profile = speed_profile(road.track, speed_kmh / 3.6, innermost)
        self._speed_control = SpeedControl(profile, road.track, car, 1.0 / frequency_hz)
        self._lane: int | None = None

    def take_over(self) -> None:
        """Reset the driver: the next command selects the lane nearest to the car."""
        self._lane = None
        self._speed_control.reset()

    def command(self, state: CarState, traffic: Traffic) -> Command:
        """Return steering, throttle, brake and gear for one control step."""
        road = self._road
        if self._lane is None:
            self._lane = tf.lane_index(state.to_middle, road.lanes, road.lane_width)
        lane_centre = tf.lane_centre(self._lane, road.lanes, road.lane_width)
        throttle, brake, gear = self._speed_control.command(state, traffic)
        steer = self._law.steer(state, lane_centre, self._law.road_curvature(state))
        return Command(steer, throttle, brake, gear)
