"""The steering law of the scripted drivers: state feedback with curvature feed-forward.

Source: Rajamani, Vehicle Dynamics and Control, 2.5 (bicycle model). The feedback is on lateral
offset, heading and yaw rate. The gains decrease with speed, so that natural frequency and damping
of the closed loop are constant. Track frame, SI units, left positive; `angle` is track tangent
minus yaw.
"""

from typing import Final

from simulator.track.road import Road
from simulator.vehicle.car import CarParameters
from simulator.vehicle.state import CarState
from simulator.vehicle.surface import SURFACES

YAW_RATE_GAIN: Final = 0.08  # s: front-wheel angle (rad) per yaw rate (rad/s)
MIN_SPEED: Final = 5.0  # m/s: bounds the gains, which grow as the speed decreases
PREVIEW_S: Final = 0.12  # about the delay by the steering rate plus the delay by the control step
MAX_OFFSET_ERROR: Final = 1.5  # m: larger errors are clipped to this value
MIN_RADIUS_FACTOR: Final = 0.3  # bounds the curvature of the path on the inside of tight bends


class LateralLaw:
    """Computes steering commands for one car on one road; it has no state."""

    def __init__(
        self, car: CarParameters, road: Road, *, natural_frequency: float, damping: float
    ) -> None:
        """Set the gains such that the controlled lateral motion has the natural frequency
        `natural_frequency` (rad/s) and the damping ratio `damping`."""
        self._car = car
        self._track = road.track
        self._rear_stiffness = car.cornering_stiffness(False, SURFACES[road.track.surface].grip)
        self._natural_frequency = natural_frequency
        self._damping = damping

    def road_curvature(self, state: CarState) -> float:
        """Return the curvature (1/m) of a path through the car that stays parallel to the road, at
        the point that the car reaches after 0.12 s."""
        curvature = self._track.curvature(state.s + feedback_speed(state) * PREVIEW_S)
        return float(curvature / max(1.0 - curvature * state.to_middle, MIN_RADIUS_FACTOR))

    def steer(
        self, state: CarState, offset: float, curvature: float, path_angle: float = 0.0
    ) -> float:
        """Return the steering command in [-1, 1], left positive, to follow a path.

        The path is at `offset` (m from the track's centre), has the curvature `curvature` (1/m) and
        the angle `path_angle` (rad) to the road.
        """
        # Recorded datasets depend on every bit of the result, so keep the order of the operations.
        car, v = self._car, feedback_speed(state)
        # Body slip angle at the centre of gravity in a steady turn (Rajamani, 3.3).
        mass_term = car.total_mass * car.front_axle * v * v / car.wheelbase
        slip = curvature * (car.rear_axle - mass_term / (2.0 * self._rear_stiffness))
        offset_error = state.to_middle - offset
        offset_error = min(max(offset_error, -MAX_OFFSET_ERROR), MAX_OFFSET_ERROR)
        heading_error = -state.angle - path_angle + slip
        offset_gain = self._natural_frequency**2 * car.wheelbase / (v * v)
        heading_gain = 2.0 * self._damping * self._natural_frequency * car.wheelbase / v
        wheel_angle = (
            car.wheelbase * curvature
            - offset_gain * offset_error
            - heading_gain * heading_error
            - YAW_RATE_GAIN * (state.yaw_rate - v * curvature)
        )
        return min(max(wheel_angle / car.steering_lock, -1.0), 1.0)

    def restart(self) -> None:
        """Do nothing: the law has no state to reset."""


def feedback_speed(state: CarState) -> float:
    """Return the speed (m/s) for which gains and preview are computed: the car's speed, at least 5
    m/s."""
    return max(state.speed, MIN_SPEED)
