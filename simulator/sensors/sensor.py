"""Sensors: each has a name, a unit, limits, noise, and a function that reads it from the world.

A custom sensor is declared in one line and read together with the others:

    slip = Sensor("side_slip", "rad", lambda world: atan2(world.state.vy, world.state.vx))
    suite = SensorSuite([*STANDARD, slip], seed=1)
    readings = suite.read(world)        # {"range": array([...]), ..., "side_slip": 0.002}

In an environment: `gymnasium.make(..., sensors=("range", "v_x", slip))`.
"""

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from simulator.world.world import World
from trackfeatures.errors import UserError

Reading = float | NDArray[Any]


@dataclass(frozen=True)
class Sensor:
    """One declared sensor; `read` returns a number or an array of `shape` in `unit`.

    Readings are clipped to `limits`. Raises UserError for contradictory limits, or for noise that
    is negative or not finite.
    """

    name: str
    unit: str
    read: Callable[[World], Reading]
    noise: float = 0.0
    """Standard deviation of the added normal noise, in `unit`; 0: no noise."""

    limits: tuple[float, float] = (-math.inf, math.inf)
    """Least and largest reading; noisy readings are clipped to them."""

    invalid: float | None = None
    """A value outside `limits` that means "no reading", such as the range meter's -1 off the track.
    It is not clipped and gets no noise."""

    shape: tuple[int, ...] = ()
    """Shape of a reading; () means a number."""

    dtype: str = "float32"
    """Data type of the reading in an environment's observation. Readings of an integer type are
    rounded to whole numbers, and `limits` are narrowed to the range of the type."""

    def __post_init__(self) -> None:
        if np.dtype(self.dtype).kind in "iu":
            range_ = np.iinfo(self.dtype)
            top = float(range_.max)  # of 64 bits it is rounded up, out of the range
            top = top if top <= range_.max else math.nextafter(top, 0.0)
            low, high = max(self.limits[0], float(range_.min)), min(self.limits[1], top)
            object.__setattr__(self, "limits", (low, high))
        if not self.limits[0] < self.limits[1]:
            raise UserError(
                f"sensor {self.name!r} has the limits {self.limits}; give the least reading first"
            )
        if self.invalid is not None and self.limits[0] <= self.invalid <= self.limits[1]:
            raise UserError(
                f"sensor {self.name!r} has the invalid reading {self.invalid}, which lies within "
                f"its limits {self.limits}; give one outside them"
            )
        if not (math.isfinite(self.noise) and self.noise >= 0.0):
            raise UserError(
                f"sensor {self.name!r} has noise {self.noise}; give a standard deviation of 0 "
                f"{self.unit} or more"
            )

    def measure(self, world: World, rng: np.random.Generator | None = None) -> Reading:
        """Return the current reading, clipped to the limits; with noise if `rng` is given.

        Raises UserError if the reading does not have the declared shape.
        """
        exact = self.read(world)
        if np.shape(exact) != self.shape:
            raise UserError(
                f"sensor {self.name!r} read something of shape {np.shape(exact)}, but declares "
                f"shape {self.shape}; set Sensor(..., shape={np.shape(exact)})"
            )
        if isinstance(exact, np.ndarray):
            return self.limit(exact, rng)
        value = float(exact)
        # Drawn for an invalid reading too: the noise depends only on the number of readings.
        noise = 0.0 if rng is None else rng.normal(0.0, self.noise)
        if value == self.invalid:
            return value
        value += noise
        if np.dtype(self.dtype).kind in "iu":
            value = float(np.rint(value))
        return min(max(value, self.limits[0]), self.limits[1])

    def limit(self, exact: NDArray[Any], rng: np.random.Generator | None = None) -> NDArray[Any]:
        """Return the readings `exact` of any shape, clipped to the limits, with noise if `rng` is
        given. Readings equal to `invalid` are not changed."""
        noisy = exact if rng is None else exact + rng.normal(0.0, self.noise, size=exact.shape)
        if exact.dtype.kind in "iu" or np.dtype(self.dtype).kind in "iu":
            noisy = np.rint(noisy)
        low, high = self.limits
        within = np.minimum(np.maximum(noisy, low), high).astype(exact.dtype, copy=False)
        return within if self.invalid is None else np.where(exact == self.invalid, exact, within)


class SensorSuite:
    """Several sensors that are read together. A sensor's noise depends only on `seed`, the sensor's
    name and the number of readings since the last restart.

    `noise` sets standard deviations by sensor name. Raises UserError if two sensors have the same
    name, or for noise of a sensor that is not in the suite.
    """

    def __init__(
        self,
        sensors: Iterable[Sensor],
        *,
        seed: int = 0,
        noise: Mapping[str, float] | None = None,
    ) -> None:
        wanted = dict(noise or {})
        self.sensors = tuple(
            replace(sensor, noise=wanted.pop(sensor.name, sensor.noise)) for sensor in sensors
        )
        names = [sensor.name for sensor in self.sensors]
        if len(set(names)) < len(names):
            raise UserError(f"two sensors share a name among {names}; rename one")
        if wanted:
            raise UserError(f"noise is set for {sorted(wanted)}, but the sensors are {names}")
        self._seed = seed
        self.restart()

    def restart(self, seed: int | None = None) -> None:
        """Restart the noise, with another seed if given. Call it at the start of an episode."""
        self._seed = self._seed if seed is None else seed
        # Each sensor has its own random stream, so an added sensor does not change other noise.
        self._rngs = [
            np.random.default_rng([self._seed, *sensor.name.encode()]) if sensor.noise else None
            for sensor in self.sensors
        ]

    def read(self, world: World) -> dict[str, Reading]:
        """Return all readings of the current state, by sensor name."""
        return {
            sensor.name: sensor.measure(world, rng)
            for sensor, rng in zip(self.sensors, self._rngs, strict=True)
        }
