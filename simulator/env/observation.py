"""What an agent observes: the paper's state, pictures, or a dict of both and of sensors."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal, get_args

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

import trackfeatures as tf
from simulator.env.view_renderer import Pictures
from simulator.sensors.sensor import Reading, Sensor, SensorSuite
from simulator.sensors.standard import CAMERA, picture_sensor, sensors_of
from simulator.world.world import World
from trackfeatures.errors import UserError

Kind = Literal["state", "image", "dict"]
Observation = dict[str, NDArray[Any]] | NDArray[Any]

KINDS: tuple[Kind, ...] = get_args(Kind)
STATE_SIZE = 7
SPEED_SCALE = 75.0 / 3.6  # m/s
PAPERS_NOISE = 0.05
STATE_LIMIT = 10.0
"""Ten half widths, 750 km/h: no drive comes near; it gives the space bounds."""
STATE, IMAGE = "state", "image"


@dataclass(frozen=True)
class ObservationOptions:
    """What an environment observes, and how exactly."""

    observation: Kind | None = None
    """"state": (7,); "image": one picture; "dict": the state, each view and each sensor by its
    name, one view alone as "image". None: what the environment is for, or a dict where `views` or
    `sensors` ask for more."""

    views: Sequence[str] | None = None
    """Names of the pictures; None is the driver's view where there is to be a picture."""

    sensors: Sequence[str | Sensor] = ()
    """Sensors by their name in the paper's table, or of the user's own."""

    noise: float | bool = 0.0
    """Standard deviation of the noise on the state; True is the paper's 0.05."""

    sensor_noise: Mapping[str, float] = field(default_factory=dict)
    """Standard deviation of a sensor's noise in its unit, by the sensor's name."""

    def __post_init__(self) -> None:
        if self.observation is not None and self.observation not in KINDS:
            raise UserError(f"observation is {self.observation!r}; choose {', '.join(KINDS)}")
        for name, value in (("views", self.views), ("sensors", self.sensors)):
            if isinstance(value, str):
                raise UserError(f'{name} is {value!r}; give a list, as in {name}=("{value}",)')
        if not (math.isfinite(self.noise) and self.noise >= 0.0):
            raise UserError(f"noise is {self.noise}; give a standard deviation of 0 or more")

    @property
    def state_noise(self) -> float:
        """Standard deviation of the noise on the state."""
        return PAPERS_NOISE if self.noise is True else float(self.noise)

    def completed(self, kind: Kind) -> "ObservationOptions":
        """With `observation` and `views` filled in for an environment that is made for `kind`.

        Raises UserError where they do not fit each other.
        """
        chosen = self.observation or ("dict" if self.views or self.sensors else kind)
        pictured = chosen == "image" or (chosen == kind == "dict")
        views = tuple(self.views) if self.views is not None else ("front",) * pictured
        if chosen != "dict" and self.sensors:
            raise UserError(f'sensors are part of observation="dict", but it is "{chosen}"')
        if chosen == "state" and views:
            raise UserError('views are part of observation="dict" or "image", but it is "state"')
        if chosen == "image" and len(views) != 1:
            raise UserError(
                f'observation="image" is one picture, but views is {views}; choose "dict"'
            )
        if len(set(views)) < len(views):
            raise UserError(f"views is {views}; name each view once")
        return replace(self, observation=chosen, views=views)


class Observer:
    """Builds an environment's observations; `options` are completed ones."""

    def __init__(self, options: ObservationOptions, pictures: Pictures) -> None:
        self._kind, self._noise = options.observation, options.state_noise
        self._pictures = pictures
        self.views = tuple(options.views or ())
        self.suite = SensorSuite(
            sensors_of(self._with_camera(options.sensors)), noise=options.sensor_noise
        )
        # The noise of a state has its own bounds: ten standard deviations more.
        self._limit = STATE_LIMIT * (1.0 + self._noise)
        self.space = self._space()

    def restart(self, seed: int) -> None:
        """Begin the sensors' noise of an episode."""
        self.suite.restart(seed)

    def observe(
        self, world: World, features: tf.TrackFeatures, rng: np.random.Generator
    ) -> Observation:
        """The observation of the present moment; `rng` draws the noise on the state."""
        if self._kind == "image":
            return self._pictures.take(world, self.views)[self.views[0]]
        state = self._state(world, features, rng)
        if self._kind == "state":
            return state
        observed: dict[str, NDArray[Any]] = {STATE: state}
        if self.views:
            taken = self._pictures.take(world, self.views)
            observed |= {self._key(view): picture for view, picture in taken.items()}
        for sensor, reading in zip(
            self.suite.sensors, self.suite.read(world).values(), strict=True
        ):
            observed[sensor.name] = _as_array(reading, sensor.dtype)
        return observed

    def _state(
        self, world: World, features: tf.TrackFeatures, rng: np.random.Generator
    ) -> NDArray[np.float32]:
        now = world.state
        state = [
            now.to_middle / world.road.half_width,
            now.angle / math.pi,
            now.vx / SPEED_SCALE,
            now.vy / SPEED_SCALE,
            0.0,
            0.0,
            0.0,
        ]
        state[4 + features.heading] = 1.0
        vector = np.array(state)
        if self._noise:
            vector += rng.normal(0.0, self._noise, size=STATE_SIZE)
        within = np.minimum(np.maximum(vector, -self._limit), self._limit)
        return np.asarray(within, dtype=np.float32)

    def _space(self) -> gym.Space[Any]:
        state = gym.spaces.Box(-self._limit, self._limit, (STATE_SIZE,), np.float32)
        views = {self._key(view): self._pictures.space(view) for view in self.views}
        if self._kind == "state":
            return state
        if self._kind == "image":
            return next(iter(views.values()))
        sensors = {sensor.name: _sensor_space(sensor) for sensor in self.suite.sensors}
        clash = sorted({STATE, *views} & set(sensors))
        if clash:
            raise UserError(f"sensors are named like the observation's own parts: {clash}")
        return gym.spaces.Dict({STATE: state, **views, **sensors})

    def _key(self, view: str) -> str:
        return IMAGE if len(self.views) == 1 else view

    def _with_camera(self, sensors: Sequence[str | Sensor]) -> list[str | Sensor]:
        """The table's camera, wherever it is asked for, is the driver's view."""
        pictures = self._pictures
        camera = picture_sensor(
            CAMERA, lambda world: pictures.take(world, ("front",))["front"], pictures.shape
        )
        return [camera if sensor == CAMERA else sensor for sensor in sensors]


def _sensor_space(sensor: Sensor) -> gym.spaces.Box:
    low, high = sensor.limits
    if sensor.invalid is not None:
        low, high = min(low, sensor.invalid), max(high, sensor.invalid)
    dtype: Any = np.dtype(sensor.dtype).type
    return gym.spaces.Box(low, high, sensor.shape or (1,), dtype)


def _as_array(reading: Reading, dtype: str) -> NDArray[Any]:
    if isinstance(reading, np.ndarray):
        return reading.astype(dtype)
    return np.array([reading], dtype)
