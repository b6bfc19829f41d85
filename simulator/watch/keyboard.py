"""Keyboard driving with four keys: left and right steer, up accelerates, down brakes."""

import time
from collections.abc import Callable
from typing import Final

from simulator.driving.speed import Pedals
from simulator.track.road import Road
from simulator.vehicle.car import CarParameters
from simulator.vehicle.state import CarState, Command

HELD_S: Final = 0.7
"""Time (s) after which keys count as released unless the browser sends them again."""
LATERAL_ACCELERATION: Final = 6.0  # m/s2: largest value in the bend that a held key causes
MAX_STEER: Final = 0.7
STEER_RATE: Final = 2.0  # 1/s: largest change of the steering action (-1 to 1) per second
MAX_SPEED: Final = 45.0  # m/s: the key "up" does not accelerate above this speed
FORWARD, BACK, COAST = 3.0, -7.0, -0.6  # m/s2: with the key "up", with "down", without both keys


class Keyboard:
    """Converts the keys held down into smooth commands. Steering is reduced at high speed, so that
    a held key causes at most 6 m/s2 of lateral acceleration."""

    def __init__(
        self, road: Road, frequency_hz: int, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._road = road
        self._dt = 1.0 / frequency_hz
        self._car = CarParameters()
        self._pedals = Pedals(self._car)
        self._clock = clock
        self.release()

    def release(self) -> None:
        """Release all keys and centre the steering."""
        self._keys: frozenset[str] = frozenset()
        self._until = 0.0
        self._steer = 0.0
        self._pedals.reset()

    def hold(self, keys: frozenset[str]) -> None:
        """Set the keys that are held down. They count as released after 0.7 s, unless `hold` is
        called again."""
        self._keys, self._until = keys, self._clock() + HELD_S

    def command(self, state: CarState) -> Command:
        """Return the command for one control step."""
        keys = self._keys if self._clock() < self._until else frozenset()
        wanted = self._reach(state.speed) * (("left" in keys) - ("right" in keys))
        most = STEER_RATE * self._dt
        self._steer += min(max(wanted - self._steer, -most), most)
        speed = max(state.speed, 0.0)
        if "down" in keys:
            acceleration = BACK if speed > 0.5 else -1.0
        elif "up" in keys and speed < MAX_SPEED:
            acceleration = FORWARD
        else:
            acceleration = COAST if speed > 0.5 else -1.0
        slope = self._road.track.slope(state.s)
        throttle, brake, gear = self._pedals.press(acceleration, speed, 0.0, slope, self._dt)
        return Command(self._steer, throttle, brake, gear)

    def _reach(self, speed: float) -> float:
        """Return the steering (0 to MAX_STEER) for a held key at `speed` (m/s).
        LATERAL_ACCELERATION limits it at high speed."""
        car = self._car
        wheel = LATERAL_ACCELERATION * car.wheelbase / max(speed * speed, 1.0)
        return min(wheel / car.steering_lock, MAX_STEER)
