"""Draws the pictures of a vector environment's cars with worker processes into shared memory."""

import os
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from simulator.bounds import check_whole
from simulator.env.cars import Cars
from simulator.env.view_renderer import RenderOptions
from simulator.vehicle.state import CarState
from simulator.world.world import World


class VectorPictures:
    """Draws the `views` of `cars`, each at most once per state. `options` are the picture options
    of each car."""

    def __init__(
        self, cars: Cars, options: Sequence[RenderOptions], views: Iterable[str], workers: int
    ) -> None:
        from simulator.camera.workers.pool import PicturePool
        from simulator.camera.workers.shared_pictures import PictureFormat

        self._cars, self._options = cars, options
        spaces = {view: options[0].space(view) for view in views}
        formats = {view: PictureFormat(box.shape, box.dtype.str) for view, box in spaces.items()}
        self._pool = PicturePool(len(options), workers, options[0].camera, formats)
        self._drawn: dict[str, list[CarState | None]] = {}
        self.close()

    def draw(self, views: Sequence[str], chosen: Iterable[int]) -> None:
        """Draw the views of the current states of the `chosen` cars, unless they are drawn already.

        Raises PictureWorkerError if a worker dies; the next `draw` starts new workers. New workers
        draw all cars, because their memory is empty.
        """
        if not self._pool.running:
            self.close()
            chosen = range(len(self._options))
        due = [
            number
            for number in chosen
            if any(self._drawn[view][number] is not self._state(number) for view in views)
        ]
        if not due:
            return
        try:
            self._pool.draw([self._shot(number) for number in due], tuple(views))
        except BaseException:
            self.close()
            raise
        for view in views:
            for number in due:
                self._drawn[view][number] = self._state(number)

    def of(self, view: str) -> NDArray[Any]:
        """Return the pictures (N, ...) of `view` in shared memory; the next `draw` changes them."""
        return self._pool.pictures(view)

    def close(self) -> None:
        """End the workers; the next `draw` starts new ones."""
        self._pool.close()
        self._drawn = {view: [None] * len(self._options) for view in self._pool.views}

    def _state(self, number: int) -> CarState:
        return self._cars.world(number).state

    def _shot(self, number: int) -> Any:
        from simulator.camera.workers.worker import Scenery, Shot

        world, options = self._cars.world(number), self._options[number]
        scenery = self._pool.number_of(Scenery(world.road, options.light, options.light_seed))
        return Shot(number, scenery, world.body_pose(), world.traffic.poses(), world.state.s)


class CarPictures:
    """The pictures of one car, with the interface of `ViewRenderer`."""

    def __init__(self, pictures: VectorPictures, number: int, options: RenderOptions) -> None:
        self._pictures, self._number, self.options = pictures, number, options

    def render(self, world: World, views: Sequence[str]) -> dict[str, NDArray[np.generic]]:
        """Return copies of the views of the car's current state, by name."""
        self._pictures.draw(views, (self._number,))
        return {view: self._pictures.of(view)[self._number].copy() for view in views}


def checked_workers(workers: Any, cars: int) -> int:
    """Return the number of processes for the option `workers`, at most `cars`. None means one per
    core."""
    if workers is None:
        workers = len(os.sched_getaffinity(0))
    return min(check_whole("workers", workers, 1), cars)
