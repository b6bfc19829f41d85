"""Builds observations: state vector, camera view, or a dict of state, views and sensors."""

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal, Protocol, get_args

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from simulator.arrays import FloatArray
from simulator.env.view_renderer import RenderOptions
from simulator.sensors.sensor import Reading, Sensor, SensorSuite
from simulator.sensors.standard import CAMERA, picture_sensor, read_track_range, sensors_of
from simulator.world.world import World
from trackfeatures.errors import UserError
from trackfeatures.state_vector import STATE_SIZE

Kind = Literal["state", "image", "dict"]
Observation = dict[str, NDArray[Any]] | NDArray[Any]

KINDS: tuple[Kind, ...] = get_args(Kind)
PAPER_STATE_NOISE = 0.05
STATE_LIMIT = 10.0
"""Bound of the absolute values of the state in its observation space: an offset of ten half widths
of the track, or a speed of 750 km/h. No drive reaches it."""
STATE, IMAGE = "state", "image"


@dataclass(frozen=True)
class ObservationOptions:
    """Contents and noise of the observations. Raises UserError for a bad option."""

    observation: Kind | None = None
    """"state": state (7,). "image": one view. "dict": the state, each view and each sensor by its
    name; a single view is named "image". None: the environment's own kind, or "dict" if `views` or
    `sensors` are given."""

    views: Sequence[str] | None = None
    """Names of the views. None: the driver's view, if the observation contains images."""

    sensors: Sequence[str | Sensor] = ()
    """Sensors, by their name in the paper's table or as Sensor objects."""

    noise: float | bool = 0.0
    """Standard deviation of the noise on the state; True is the paper's value, 0.05."""

    sensor_noise: Mapping[str, float] = field(default_factory=dict)
    """Standard deviation of the noise of sensors, in each sensor's unit, by sensor name."""

    def __post_init__(self) -> None:
        if self.observation is not None and self.observation not in KINDS:
            raise UserError(f"observation is {self.observation!r}; choose {', '.join(KINDS)}")
        for name, value in (("views", self.views or ()), ("sensors", self.sensors)):
            if isinstance(value, str):
                raise UserError(f'{name} is {value!r}; give a list, as in {name}=("{value}",)')
            if not isinstance(value, Collection):
                raise UserError(f"{name} is {value!r}; give a list")
        number = isinstance(self.noise, int | float | np.number)
        if not (number and math.isfinite(self.noise) and self.noise >= 0.0):
            raise UserError(f"noise is {self.noise!r}; give a standard deviation of 0 or more")
        if not isinstance(self.sensor_noise, Mapping):
            raise UserError(
                f"sensor_noise is {self.sensor_noise!r}; give a dict of standard deviations by "
                "the sensors' names"
            )

    @property
    def state_noise(self) -> float:
        """Standard deviation of the noise on the state; 0.05 if the option `noise` is True."""
        return PAPER_STATE_NOISE if self.noise is True else float(self.noise)

    @property
    def limit(self) -> float:
        """Bound of the absolute values of the state: 10, plus ten standard deviations of the
        noise."""
        return STATE_LIMIT * (1.0 + self.state_noise)

    def resolved(self, kind: Kind) -> "ObservationOptions":
        """Return a copy in which `observation` and `views` are not None. None is replaced by the
        value that the remaining options and the `kind` of the environment imply.

        Raises UserError for options that contradict each other.
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


class Renderer(Protocol):
    """An object that draws views of one car's world."""

    @property
    def options(self) -> RenderOptions: ...

    def render(self, world: World, views: Sequence[str]) -> dict[str, NDArray[Any]]:
        """Return copies of the views of the current state, in the order of `views`."""


class Observer:
    """Builds the observations of one car; `options` must be the result of
    `ObservationOptions.resolved`.

    `beams` (19,) are the distances (m) of the range meter in the current state. With None they are
    computed when the sensor is read.
    """

    def __init__(
        self, options: ObservationOptions, renderer: Renderer, beams: FloatArray | None = None
    ) -> None:
        self.kind = options.observation
        self._renderer = renderer
        self.views = tuple(options.views or ())
        sensors = sensors_of(self._replace_camera(options.sensors))
        from_beams = [sensor.name for sensor in sensors if read_from_beams(sensor)]
        if beams is not None:
            sensors = tuple(
                replace(sensor, read=lambda world: beams) if sensor.name in from_beams else sensor
                for sensor in sensors
            )
        self.suite = SensorSuite(sensors, noise=options.sensor_noise)
        self.batched = all(
            sensor.name in from_beams and not sensor.noise for sensor in self.suite.sensors
        )
        """Whether the observation has no sensors other than range meters without noise."""
        self._limit = options.limit
        self.space = self._space()

    def restart(self, seed: int) -> None:
        """Seed the noise of the sensors for an episode."""
        self.suite.restart(seed)

    def observe(self, world: World, state: NDArray[np.float32]) -> Observation:
        """Return the observation of `world`'s current state, whose state vector is `state` (7,)."""
        if self.kind == "image":
            return self._renderer.render(world, self.views)[self.views[0]]
        if self.kind == "state":
            return state
        observed: dict[str, NDArray[Any]] = {STATE: state}
        if self.views:
            images = self._renderer.render(world, self.views)
            observed |= {self.key(view): image for view, image in images.items()}
        return observed | self.read_sensors(world)

    def read_sensors(self, world: World) -> dict[str, NDArray[Any]]:
        """Return the readings of all sensors in the current state, by sensor name."""
        return {
            sensor.name: _as_array(reading, sensor.dtype)
            for sensor, reading in zip(
                self.suite.sensors, self.suite.read(world).values(), strict=True
            )
        }

    def _space(self) -> gym.Space[Any]:
        state = gym.spaces.Box(-self._limit, self._limit, (STATE_SIZE,), np.float32)
        views = {self.key(view): self._renderer.options.space(view) for view in self.views}
        if self.kind == "state":
            return state
        if self.kind == "image":
            return next(iter(views.values()))
        sensors = {sensor.name: _sensor_space(sensor) for sensor in self.suite.sensors}
        clash = sorted({STATE, *views} & set(sensors))
        if clash:
            raise UserError(f"sensors are named like other parts of the observation: {clash}")
        return gym.spaces.Dict({STATE: state, **views, **sensors})

    def key(self, view: str) -> str:
        """Return the name of a view in an observation of kind "dict"."""
        return IMAGE if len(self.views) == 1 else view

    def _replace_camera(self, sensors: Sequence[str | Sensor]) -> list[str | Sensor]:
        """Replace the name "camera" by a sensor that renders the driver's view."""
        renderer = self._renderer
        camera = picture_sensor(
            CAMERA,
            lambda world: renderer.render(world, ("front",))["front"],
            renderer.options.shape,
        )
        return [camera if sensor == CAMERA else sensor for sensor in sensors]


def read_from_beams(sensor: str | Sensor) -> bool:
    """Return whether `sensor` is a range meter. An environment reads range meters from the beams
    that the control step computes."""
    return sensor != CAMERA and sensors_of([sensor])[0].read is read_track_range


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
