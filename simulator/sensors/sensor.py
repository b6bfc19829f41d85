"""What a sensor is: a name, a unit, how to read it off the world, and its noise.

A sensor of your own is one line, and reads along with the others:

    slip = Sensor("side_slip", "rad", lambda world: atan2(world.state.vy, world.state.vx))
    suite = SensorSuite([*STANDARD, slip], seed=1)
    readings = suite.read(world)        # {"angle": 0.01, ..., "side_slip": 0.002}
"""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from simulator.world import World
from trackfeatures.errors import UserError

Reading = float | NDArray[Any]


@dataclass(frozen=True)
class Sensor:
    """One declared sensor; `read` returns a number or an array in `unit`."""

    name: str
    unit: str
    read: Callable[[World], Reading]
    noise: float = 0.0
    """Standard deviation of the added normal noise, in `unit`; 0 is a perfect sensor."""

    limits: tuple[float, float] | None = None
    """Least and largest valid reading. Noise stays within them, and leaves a reading outside them,
    such as the range meter's -1 off the track, as it is."""

    def __post_init__(self) -> None:
        if self.limits is not None and not self.limits[0] < self.limits[1]:
            raise UserError(
                f"sensor {self.name!r} has the limits {self.limits}; give the least reading first"
            )
        if not (np.isfinite(self.noise) and self.noise >= 0.0):
            raise UserError(
                f"sensor {self.name!r} has noise {self.noise}; give a standard deviation of 0 "
                f"{self.unit} or more"
            )


class SensorSuite:
    """Several sensors read together; their noise depends on `seed` and the order of reading only.

    `noise` sets standard deviations by sensor name. Raises UserError for two sensors of one name
    or noise for a sensor that is not there.
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

    def restart(self) -> None:
        """Begin the noise anew, as at construction; call at the start of an episode."""
        # One stream a sensor: adding a sensor leaves the noise of the others as it was.
        self._rngs = [
            np.random.default_rng([self._seed, *sensor.name.encode()]) for sensor in self.sensors
        ]

    def read(self, world: World) -> dict[str, Reading]:
        """All readings of the present moment, by name."""
        return {
            sensor.name: _noisy(sensor, world, rng)
            for sensor, rng in zip(self.sensors, self._rngs, strict=True)
        }


def _noisy(sensor: Sensor, world: World, rng: np.random.Generator) -> Reading:
    reading = sensor.read(world)
    if sensor.noise == 0.0:
        return reading
    exact = np.asarray(reading)
    noisy = exact + rng.normal(0.0, sensor.noise, size=exact.shape)
    if sensor.limits is not None:
        low, high = sensor.limits
        valid = (low <= exact) & (exact <= high)
        noisy = np.where(valid, np.clip(noisy, low, high), exact)
    return noisy if isinstance(reading, np.ndarray) else float(noisy)
