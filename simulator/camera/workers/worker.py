"""A worker process that draws pictures of cars into shared memory; `pool` starts it.

It has one OpenGL context, and a camera for each scene of its cars.
"""

import os
import sys
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass
from multiprocessing.connection import Connection
from typing import Any

from numpy.typing import NDArray

from simulator.arrays import FloatArray
from simulator.camera.core.camera import Camera, open_camera
from simulator.camera.core.render_modes import bounded
from simulator.camera.workers.shared_pictures import PictureFormat, map_pictures
from simulator.track.road import Road
from trackfeatures.camera import CameraParameters
from trackfeatures.errors import UserError

PARENT_CHECK_S = 2.0
"""Interval at which an idle worker checks that its parent is alive. The end of the connection is
not sufficient, because a process forked from the parent may hold the connection open."""


@dataclass(frozen=True, eq=False)
class Scenery:
    """The arguments of `open_camera` that determine a scene."""

    road: Road
    light: str
    light_seed: int


@dataclass(frozen=True, eq=False)
class Shot:
    """A request to draw the pictures of one car: number of the scenery, body pose (6,), poses of
    other cars (n, 6), and distance (m) along the road."""

    car: int
    scenery: int
    pose: FloatArray
    others: FloatArray
    s: float


@dataclass(frozen=True)
class Setup:
    """The first message to a worker, with the values that are constant for its lifetime."""

    cars: int
    formats: dict[str, PictureFormat]
    camera: CameraParameters
    cameras: int
    """Largest number of cameras that the worker keeps."""


@dataclass(frozen=True, eq=False)
class Task:
    """Shots to draw, each in all `views`, and the sceneries that are new to this worker."""

    shots: list[Shot]
    views: tuple[str, ...]
    sceneries: dict[int, Scenery]


class Cameras:
    """Keeps the cameras of the `most` sceneries that were used last. `build` makes a camera."""

    def __init__(self, most: int, build: Callable[[Scenery], Camera]) -> None:
        self._most, self._build = most, build
        self._sceneries: dict[int, Scenery] = {}
        self._cameras: OrderedDict[int, Camera] = OrderedDict()

    def add(self, sceneries: dict[int, Scenery]) -> None:
        self._sceneries |= sceneries

    def of(self, scenery: int) -> Camera:
        """Return the camera of scenery number `scenery`, built at first use."""
        if scenery not in self._cameras:
            while len(self._cameras) >= self._most:
                self._cameras.popitem(last=False)[1].close()
            self._cameras[scenery] = self._build(self._sceneries[scenery])
        self._cameras.move_to_end(scenery)
        return self._cameras[scenery]


def main(connection: Connection, descriptor: int, parent: int) -> None:
    """Draw the shots of each task until the parent ends. Each drawn picture is answered with the
    number of its car. A UserError is sent to the parent and ends the process. `descriptor` is the
    shared memory, `parent` the parent's process id."""
    setup: Setup = connection.recv()
    pictures = map_pictures(descriptor, setup.cars, setup.formats)
    os.close(descriptor)
    cameras = Cameras(
        setup.cameras,
        lambda scenery: open_camera(
            scenery.road, setup.camera, light=scenery.light, seed=scenery.light_seed
        ),
    )
    try:
        while True:
            while not connection.poll(PARENT_CHECK_S):
                if os.getppid() != parent:
                    return
            task: Task = connection.recv()
            cameras.add(task.sceneries)
            for shot in task.shots:
                draw(shot, task.views, cameras, pictures)
                connection.send(shot.car)
    except (EOFError, ConnectionError):
        return  # the parent has ended or has closed the pool
    except UserError as error:
        connection.send(error)


def draw(
    shot: Shot, views: tuple[str, ...], cameras: Cameras, pictures: dict[str, NDArray[Any]]
) -> None:
    """Draw `views` of the car of `shot` into that car's rows of `pictures` (cars, *shape). The
    camera of the car's scenery is taken from `cameras`."""
    camera = cameras.of(shot.scenery)
    drawn = camera.render_views(shot.pose, shot.others, views, near_s=shot.s)
    for view, picture in drawn.items():
        pictures[view][shot.car] = bounded(picture)


if __name__ == "__main__":
    main(Connection(int(sys.argv[1])), int(sys.argv[2]), int(sys.argv[3]))
