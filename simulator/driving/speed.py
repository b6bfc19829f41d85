"""Speed control of the scripted drivers. It computes a speed profile of the track, and the
throttle, brake and gear with which a car follows the profile. SI units."""

from dataclasses import dataclass
from math import inf

import numpy as np
from numpy.typing import NDArray

from simulator.track.geometry import Track
from simulator.traffic.idm import idm_acceleration
from simulator.traffic.traffic import Traffic
from simulator.vehicle.car import GRAVITY, RPM, CarParameters
from simulator.vehicle.state import CarState

LATERAL_ACCELERATION = 4.0  # m/s2: largest value in bends
BRAKING = 2.5  # m/s2: largest deceleration before bends
PREVIEW_S = 0.5
CELL_M = 1.0
SHIFT_UP_RPM, SHIFT_DOWN_RPM = 5500.0, 2600.0
TOP_GEAR = 4
MAX_THROTTLE = 0.9
INTEGRAL_GAIN = 0.15  # 1/s2: acceleration (m/s2) per integrated error of the speed (m)
INTEGRAL_LIMIT = 1.0  # m/s2: largest acceleration that the integral adds


@dataclass(frozen=True)
class SpeedProfile:
    """Speed limits `limit` (cells,), m/s, of cells of `cell_m` (m) along the lap. They allow for
    the bends and for the braking distance before each bend."""

    limit: NDArray[np.float64]
    cell_m: float

    def at(self, s: float) -> float:
        """Return the limit (m/s) at `s` (m); the profile repeats every lap."""
        return float(self.limit[int(s / self.cell_m) % len(self.limit)])


def speed_profile(track: Track, desired: float, innermost_y: float) -> SpeedProfile:
    """Compute the speed profile of `track`. Its limits allow for bends and braking and are at most
    `desired` (m/s). `innermost_y` (m) is the largest offset to the inside of the centre line at
    which bends are driven."""
    bends = bend_profile(track, innermost_y)
    return SpeedProfile(np.minimum(bends.limit, desired), bends.cell_m)


def bend_profile(track: Track, innermost_y: float) -> SpeedProfile:
    """Compute the speed profile of `track` that only bends and the braking before them limit.
    `innermost_y` (m) is the largest offset to the inside of the centre line at which bends are
    driven."""
    cells = int(np.ceil(track.length_m / CELL_M))
    cell = track.length_m / cells
    bend = np.abs(track.at((np.arange(cells) + 0.5) * cell).curvature)
    bend = bend / np.maximum(1.0 - bend * innermost_y, 0.3)
    squared = np.tile(LATERAL_ACCELERATION / np.maximum(bend, 1e-6), 2)
    # v^2 can decrease by 2 * BRAKING per metre. The bend ahead that requires the lowest speed here
    # sets the limit. Two laps are computed, because at the end of a lap the car brakes for the
    # bends of the next lap.
    drop = 2.0 * BRAKING * cell * np.arange(2 * cells)
    allowed = np.minimum.accumulate((squared + drop)[::-1])[::-1] - drop
    return SpeedProfile(np.sqrt(allowed[:cells]), cell)


class Pedals:
    """Converts an acceleration into throttle, brake and gear with an inverse model of the car."""

    def __init__(self, car: CarParameters) -> None:
        self._car = car
        self._drag = 0.5 * car.air_density * car.drag_coefficient * car.frontal_area
        self._gear = 1
        self._integral = 0.0

    def reset(self) -> None:
        self._gear, self._integral = 1, 0.0

    def press(
        self, acceleration: float, speed: float, error: float, slope: float, dt: float
    ) -> tuple[float, float, int]:
        """Return throttle, brake (0 to 1) and gear for `acceleration` (m/s2) at `speed` (m/s) on a
        road with `slope` (rise per m).

        The integral of `error` (target minus actual speed, m/s) compensates errors of the model.
        `dt` is the time since the last call (s).
        """
        car = self._car
        step = INTEGRAL_GAIN * error * dt
        self._integral = min(max(self._integral + step, -INTEGRAL_LIMIT), INTEGRAL_LIMIT)
        resistance = self._drag * speed**2 + car.rolling_resistance * car.total_mass * GRAVITY
        force = car.total_mass * (acceleration + self._integral + GRAVITY * slope) + resistance
        gear = self._choose_gear(speed)
        if force < 0.0:
            return 0.0, min(-force * car.wheel_radius / car.brake_torque, 1.0), gear
        # The throttle must first overcome the engine braking at closed throttle; see `powertrain`.
        braking = self._engine_braking(speed, gear)
        throttle = (force / self._full_throttle_force(speed, gear) + braking) / (1.0 + braking)
        return min(throttle, MAX_THROTTLE), 0.0, gear

    def _choose_gear(self, speed: float) -> int:
        """Return the gear for `speed` (m/s). It differs by at most one from the gear of the last
        call."""
        if self._rpm(speed, self._gear) > SHIFT_UP_RPM and self._gear < TOP_GEAR:
            self._gear += 1
        elif self._rpm(speed, self._gear) < SHIFT_DOWN_RPM and self._gear > 1:
            self._gear -= 1
        return self._gear

    def _rpm(self, speed: float, gear: int) -> float:
        return speed / self._car.wheel_radius * self._ratio(gear) * RPM

    def _ratio(self, gear: int) -> float:
        return self._car.gears[gear - 1] * self._car.final_drive

    def _engine_braking(self, speed: float, gear: int) -> float:
        """Return the engine's braking torque at closed throttle, at `speed` (m/s) in `gear`, as a
        share of the full-load torque."""
        car = self._car
        above = max(self._rpm(speed, gear) - car.idle_rpm, 0.0)
        return car.engine_braking * above / (car.top_rpm - car.idle_rpm)

    def _full_throttle_force(self, speed: float, gear: int) -> float:
        """Return the driving force (N) at full throttle, at `speed` (m/s) in `gear`."""
        car = self._car
        rpm = max(self._rpm(speed, gear), car.idle_rpm)
        torque = float(np.interp(rpm, np.arange(len(car.torque)) * 1000.0, car.torque))
        return torque * self._ratio(gear) * car.driveline_efficiency / car.wheel_radius


class TargetSpeed:
    """Computes throttle, brake and gear that reach a speed and keep the distance to the car ahead
    (the leader)."""

    def __init__(self, car: CarParameters, step_s: float) -> None:
        """`step_s` is the time between two commands (s)."""
        self._pedals = Pedals(car)
        self._step_s = step_s
        self.following = False
        """Whether the distance to the car ahead limited the acceleration of the last command."""

    def reset(self) -> None:
        self._pedals.reset()

    def command(
        self, state: CarState, traffic: Traffic, target: float, slope: float
    ) -> tuple[float, float, int]:
        """Return throttle, brake and gear for one control step towards `target` (m/s) on a road
        with `slope` (rise per m)."""
        speed = max(state.speed, 0.0)
        follow = inf
        leader = traffic.leader(state.s, state.to_middle) if traffic.count else None
        if leader is not None:
            follow = float(idm_acceleration(leader[0], speed, leader[1], max(target, 1.0)))
        acceleration = target_acceleration(speed, target, follow)
        # Behind a leader no error is integrated: the car is slower than the target on purpose.
        self.following = follow <= acceleration
        error = 0.0 if self.following else target - speed
        error = error if abs(error) < BRAKING else 0.0
        return self._pedals.press(acceleration, speed, error, slope, self._step_s)


class SpeedControl:
    """Computes throttle, brake and gear that follow a speed profile of the track and keep the
    distance to the car ahead."""

    def __init__(
        self, profile: SpeedProfile, track: Track, car: CarParameters, step_s: float
    ) -> None:
        """`profile` contains the speed limits, and `step_s` is the time between two commands
        (s)."""
        self._profile = profile
        self._track = track
        self._follower = TargetSpeed(car, step_s)

    def reset(self) -> None:
        self._follower.reset()

    def command(self, state: CarState, traffic: Traffic) -> tuple[float, float, int]:
        """Return throttle, brake (0 to 1) and gear for one control step."""
        target = self._profile.at(state.s + PREVIEW_S * max(state.speed, 0.0))
        slope = float(self._track.slope(state.s))
        return self._follower.command(state, traffic, target, slope)


def target_acceleration(speed: float, target: float, follow: float = inf) -> float:
    """Return the acceleration (m/s2) with which a comfortable driver changes `speed` to `target`
    (both m/s): from -4 to 2 m/s2, or `follow` if that is lower.

    `follow` (m/s2) is the acceleration that the distance to the car ahead allows.
    """
    free = min(max(1.2 * (target - speed), -BRAKING * 1.6), 2.0)
    return min(free, follow)
