"""How fast and in which gear: a speed profile of the track, engine and brake commands. SI units."""

from dataclasses import dataclass
from math import inf

import numpy as np
from numpy.typing import NDArray

from simulator.track.geometry import Track
from simulator.vehicle.car import GRAVITY, RPM, CarParameters

SIDE_ACCELERATION = 4.0  # m/s2 in bends
BRAKING = 2.5  # m/s2 before them
CELL_M = 1.0
SHIFT_UP_RPM, SHIFT_DOWN_RPM = 5500.0, 2600.0
TOP_GEAR = 4
MOST_THROTTLE = 0.9
INTEGRAL_GAIN = 0.15  # 1/s2
INTEGRAL_LIMIT = 1.0  # m/s2


@dataclass(frozen=True)
class SpeedProfile:
    """Highest speed (m/s) at each metre of the loop, braking before its bends included."""

    limit: NDArray[np.float64]
    cell_m: float

    def at(self, s: float) -> float:
        return float(self.limit[int(s / self.cell_m) % len(self.limit)])


def speed_profile(track: Track, desired: float, innermost_y: float) -> SpeedProfile:
    """`desired` m/s where the road allows it; `innermost_y` (m) is how far inside a bend cuts."""
    bends = bend_profile(track, innermost_y)
    return SpeedProfile(np.minimum(bends.limit, desired), bends.cell_m)


def bend_profile(track: Track, innermost_y: float) -> SpeedProfile:
    """What the bends alone allow, m/s, for a driver whose wish is no limit."""
    cells = int(np.ceil(track.length_m / CELL_M))
    cell = track.length_m / cells
    bend = np.abs(track.at((np.arange(cells) + 0.5) * cell).curvature)
    bend = bend / np.maximum(1.0 - bend * innermost_y, 0.3)
    squared = np.tile(SIDE_ACCELERATION / np.maximum(bend, 1e-6), 2)
    # The bend that is hardest to brake for counts; twice round: the end brakes for the beginning.
    fall = 2.0 * BRAKING * cell * np.arange(2 * cells)
    hardest = np.minimum.accumulate((squared + fall)[::-1])[::-1] - fall
    return SpeedProfile(np.sqrt(hardest[:cells]), cell)


class Pedals:
    """Turns a wanted acceleration into throttle, brake and gear, by the car's own figures."""

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
        """Throttle, brake, gear. `error` = wanted less present speed trims what the model lacks."""
        car = self._car
        step = INTEGRAL_GAIN * error * dt
        self._integral = min(max(self._integral + step, -INTEGRAL_LIMIT), INTEGRAL_LIMIT)
        resistance = self._drag * speed**2 + car.rolling_resistance * car.total_mass * GRAVITY
        force = car.total_mass * (acceleration + self._integral + GRAVITY * slope) + resistance
        gear = self._choose_gear(speed)
        if force < 0.0:
            return 0.0, min(-force * car.wheel_radius / car.brake_torque, 1.0), gear
        # The engine's own braking takes its share first (see `engine.engine_torque`).
        braking = self._engine_braking(speed, gear)
        wanted = (force / self._pull(speed, gear) + braking) / (1.0 + braking)
        return min(wanted, MOST_THROTTLE), 0.0, gear

    def _choose_gear(self, speed: float) -> int:
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
        """Share of the full-load torque that a closed throttle takes."""
        car = self._car
        above = max(self._rpm(speed, gear) - car.idle_rpm, 0.0)
        return car.engine_braking * above / (car.top_rpm - car.idle_rpm)

    def _pull(self, speed: float, gear: int) -> float:
        """Force (N) of full throttle."""
        car = self._car
        rpm = max(self._rpm(speed, gear), car.idle_rpm)
        torque = float(np.interp(rpm, np.arange(len(car.torque)) * 1000.0, car.torque))
        return torque * self._ratio(gear) * car.driveline_efficiency / car.wheel_radius


def wanted_acceleration(speed: float, target: float, pressed: float = inf) -> float:
    """Towards `target`, within comfort; `pressed` is what the car ahead allows (m/s2)."""
    free = min(max(1.2 * (target - speed), -BRAKING * 1.6), 2.0)
    return min(free, pressed)
