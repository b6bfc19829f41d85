"""Builds the observations of all cars of a vector environment."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from simulator.env.cars import Cars
from simulator.env.observation import STATE, Kind, ObservationOptions, Observer
from simulator.env.vector_pictures import CarPictures, VectorPictures
from simulator.env.view_renderer import RenderOptions
from simulator.sensors.standard import CAMERA


class VectorObserver:
    """Builds the observations of `cars`. `options` must be the result of
    `ObservationOptions.resolved`. `pictures` contains the picture options of each car; `workers`
    processes draw the pictures.

    `render_view` is an additional view that `frames` returns, or None. If `copy`, pictures are
    copied out of the shared memory, so that the next step does not change them.
    """

    def __init__(
        self,
        cars: Cars,
        options: ObservationOptions,
        pictures: Sequence[RenderOptions],
        *,
        render_view: str | None,
        workers: int,
        copy: bool,
    ) -> None:
        count = len(pictures)
        self._cars, self._copy, self._render_view = cars, copy, render_view
        self._views = tuple(options.views or ())
        # The sensor "camera" shows the front view.
        self._drawn_views = tuple(
            dict.fromkeys((*self._views, *["front"] * (CAMERA in options.sensors)))
        )
        views = dict.fromkeys((*self._drawn_views, *([render_view] if render_view else [])))
        self._pictures = VectorPictures(cars, pictures, views, workers)
        self._observers = [
            Observer(options, CarPictures(self._pictures, number, own), cars.beams_of(number))
            for number, own in enumerate(pictures)
        ]
        self._first = self._observers[0]
        self.single_space = self._first.space
        self.space = batch_space(self.single_space, count)
        self._readings = {
            sensor.name: np.zeros((count, *(sensor.shape or (1,))), sensor.dtype)
            for sensor in self._first.suite.sensors
        }

    def restart(self, number: int, episode: int) -> None:
        """Seed the noise of the sensors of car `number` with `episode`, the seed of the episode."""
        self._observers[number].restart(episode)

    def observe(self, chosen: NDArray[np.bool_]) -> Any:
        """Return the observations of all cars. The pictures are drawn and the sensors are read only
        for the `chosen` cars (N,). The pictures and readings of the remaining cars are the ones of
        the last call."""
        kind: Kind | None = self._first.kind
        if kind == "state":
            return self._cars.states.copy()
        numbers = np.flatnonzero(chosen).tolist()
        if self._drawn_views:
            self._pictures.draw(self._drawn_views, numbers)
        if kind == "image":
            return self._of(self._views[0])
        views = {self._first.key(view): self._of(view) for view in self._views}
        return {STATE: self._cars.states.copy()} | views | self._read_sensors(numbers)

    def frames(self) -> tuple[NDArray[np.uint8], ...]:
        """Return the picture (H, W, 3) of the view `render_view` of each car."""
        view = str(self._render_view)
        self._pictures.draw((view,), range(len(self._observers)))
        return tuple(self._pictures.of(view).copy())

    def close(self) -> None:
        """End the processes that draw pictures."""
        self._pictures.close()

    def _of(self, view: str) -> NDArray[Any]:
        pictures = self._pictures.of(view)
        return pictures.copy() if self._copy else pictures

    def _read_sensors(self, numbers: Sequence[int]) -> dict[str, NDArray[Any]]:
        """Read the sensors of the cars `numbers` again; returns the readings (N, ...) of all cars
        by sensor name."""
        if self._first.batched:
            return {
                sensor.name: sensor.limit(self._cars.beams).astype(sensor.dtype)
                for sensor in self._first.suite.sensors
            }
        for number in numbers:
            world = self._cars.world(number)
            for name, reading in self._observers[number].read_sensors(world).items():
                self._readings[name][number] = reading
        return {name: readings.copy() for name, readings in self._readings.items()}
