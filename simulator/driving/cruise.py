"""A built-in driver: keeps its lane by state feedback, slows down for bends, keeps its distance.

Steering is state feedback on offset, heading and yaw rate with the road's curvature fed forward
(Rajamani, Vehicle Dynamics and Control, 2.5); the gains fall with speed, so that the answer is
alike at all of them. Track frame, left positive; `angle` is track tangent minus yaw.
"""

from typing import Final

import trackfeatures as tf
from simulator.driving.speed import BRAKING, Pedals, speed_profile, wanted_acceleration
from simulator.track.road import Road
from simulator.traffic.idm import idm_acceleration
from simulator.traffic.traffic import Traffic
from simulator.vehicle.car import CarParameters
from simulator.vehicle.state import CarState, Command
from simulator.vehicle.surface import SURFACES

CRUISE_KMH: Final = 60.0
NATURAL_FREQUENCY: Final = 2.0  # rad/s of the lateral motion
DAMPING: Final = 0.9
YAW_RATE_GAIN: Final = 0.08  # s
LEAST_SPEED: Final = 5.0  # m/s: below, the gains would grow without bound
PREVIEW_S: Final = 0.12  # about what steering rate and the control step cost
FARTHEST_OFF: Final = 1.5  # m: from farther off it steers back no harder


class Cruise:
    """Drives `road` at up to `speed_kmh` in the lane it finds itself in when it takes over."""

    def __init__(
        self,
        road: Road,
        *,
        speed_kmh: float = CRUISE_KMH,
        frequency_hz: int = 20,
        car: CarParameters | None = None,
    ) -> None:
        self._road = road
        self._car = car or CarParameters()
        grip = SURFACES[road.track.surface].grip
        self._rear_stiffness = self._car.cornering_stiffness(False, grip)
        self._pedals = Pedals(self._car)
        self._dt = 1.0 / frequency_hz
        innermost = abs(tf.lane_centre(0, road.lanes, road.lane_width))
        self._profile = speed_profile(road.track, speed_kmh / 3.6, innermost)
        self._lane: int | None = None

    def take_over(self) -> None:
        """Begin anew: the next command chooses the lane nearest to the car."""
        self._lane = None
        self._pedals.reset()

    def command(self, state: CarState, traffic: Traffic) -> Command:
        """The command for one control step."""
        road = self._road
        if self._lane is None:
            self._lane = tf.lane_index(state.to_middle, road.lanes, road.lane_width)
        wanted = tf.lane_centre(self._lane, road.lanes, road.lane_width)
        throttle, brake, gear = self._drive(state, traffic)
        return Command(self._steer(state, wanted), throttle, brake, gear)

    def _steer(self, state: CarState, wanted: float) -> float:
        car, v = self._car, max(state.speed, LEAST_SPEED)
        kappa = self._road.track.curvature(state.s + v * PREVIEW_S)
        kappa /= max(1.0 - kappa * state.to_middle, 0.3)
        # At speed the body stands askew in a bend: the slip of the centre of gravity.
        pressed = car.total_mass * car.front_axle * v * v / car.wheelbase
        slip = kappa * (car.rear_axle - pressed / (2.0 * self._rear_stiffness))
        off = min(max(state.to_middle - wanted, -FARTHEST_OFF), FARTHEST_OFF)
        gain = NATURAL_FREQUENCY**2 * car.wheelbase / (v * v)
        heading_gain = 2.0 * DAMPING * NATURAL_FREQUENCY * car.wheelbase / v
        wheel = (
            car.wheelbase * kappa
            - gain * off
            - heading_gain * (slip - state.angle)
            - YAW_RATE_GAIN * (state.yaw_rate - v * kappa)
        )
        return min(max(wheel / car.steering_lock, -1.0), 1.0)

    def _drive(self, state: CarState, traffic: Traffic) -> tuple[float, float, int]:
        speed = max(state.speed, 0.0)
        target = self._profile.at(state.s + 0.5 * speed)
        leader = traffic.leader(state.s, state.to_middle) if traffic.count else None
        acceleration = wanted_acceleration(speed, target)
        error = target - speed
        if leader is not None:
            followed = float(idm_acceleration(leader[0], speed, leader[1], max(target, 1.0)))
            # The trim is for a free road: behind a car, the wanted speed is not the target.
            error = error if followed > acceleration else 0.0
            acceleration = min(acceleration, followed)
        error = error if abs(error) < BRAKING else 0.0
        slope = self._road.track.slope(state.s)
        return self._pedals.press(acceleration, speed, error, slope, self._dt)
