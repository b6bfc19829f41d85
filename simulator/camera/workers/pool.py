"""Starts worker processes that draw the pictures of many cars; each worker draws its own cars.

The workers are new interpreters. They are not forked, because OpenGL does not survive a fork, and
they do not import the user's script, so the script needs no `if __name__ == "__main__"`.
"""

import os
import signal
import socket
import struct
import subprocess
import sys
import weakref
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from multiprocessing.connection import Connection, wait
from time import monotonic
from typing import Any

from numpy.typing import NDArray

from runtime.worker_threads import thread_limits
from simulator.camera.workers.shared_pictures import PictureFormat, create_memory, map_pictures
from simulator.camera.workers.worker import Scenery, Setup, Shot, Task
from trackfeatures.camera import CameraParameters
from trackfeatures.errors import UserError

SILENCE_S = 300
"""Longest wait (s) for one picture; it may require a new scene, which takes seconds to build."""
END_S = 5.0
KEPT_CAMERAS = 8
"""Least number of cameras that a worker keeps, as cars on random roads return to earlier ones."""
MODULE = "simulator.camera.workers.worker"


class PictureWorkerError(UserError):
    """Raised if a worker process has ended or does not answer, so that there are no pictures."""


@dataclass(eq=False)
class _Worker:
    """A worker process and the connection to it. `cars` are its cars, `sceneries` the numbers of
    the sceneries sent to it, and `due` the cars whose pictures it has not drawn yet."""

    number: int
    process: "subprocess.Popen[bytes]"
    connection: Connection
    cars: range
    sceneries: set[int] = field(default_factory=set)
    due: set[int] = field(default_factory=set)
    heard: float = 0.0
    """Time (`monotonic`, s) of the worker's last answer, or of the last task sent to it."""


class PicturePool:
    """Draws pictures of `cars` cars in `workers` processes.

    `formats` contains shape and dtype of one car's picture of each view, by the view's name. The
    first picture starts the processes. An error, Ctrl-C or `close` ends the processes and frees
    their shared memory; the next picture starts new processes.
    """

    def __init__(
        self,
        cars: int,
        workers: int,
        camera: CameraParameters,
        formats: dict[str, PictureFormat],
    ) -> None:
        self._cars, self._camera, self._formats = cars, camera, formats
        self._bounds = [cars * k // workers for k in range(workers + 1)]
        self._workers: list[_Worker] = []
        self._pictures: dict[str, NDArray[Any]] = {}
        self._owner = 0
        self._end: Callable[[], object] = _nothing
        self._sceneries: list[Scenery] = []
        self._numbers: dict[tuple[int, str, int], int] = {}

    @property
    def views(self) -> tuple[str, ...]:
        """Names of the views that have room in the shared memory."""
        return tuple(self._formats)

    @property
    def running(self) -> bool:
        """Whether this process has started workers. In a forked child the parent's workers do not
        count."""
        return bool(self._workers) and self._owner == os.getpid()

    def number_of(self, scenery: Scenery) -> int:
        """Return the number by which a `Shot` refers to `scenery`. A scenery is sent to a worker
        only once."""
        key = (id(scenery.road), scenery.light, scenery.light_seed)  # _sceneries keeps the road
        if key not in self._numbers:
            self._numbers[key] = len(self._sceneries)
            self._sceneries.append(scenery)
        return self._numbers[key]

    def pictures(self, view: str) -> NDArray[Any]:
        """Return the pictures (cars, *shape) of `view` in the shared memory. The picture of a car
        that was never drawn is all zeros."""
        self._start()
        return self._pictures[view]

    def draw(self, shots: Sequence[Shot], views: tuple[str, ...]) -> None:
        """Draw `views` of the car of each of `shots`. Raises PictureWorkerError, which names the
        worker, if a worker dies or does not answer, and the UserError of a worker that cannot
        draw."""
        try:
            self._start()
            for worker in self._workers:
                own = [shot for shot in shots if shot.car in worker.cars]
                if own:
                    self._send(worker, own, views)
            while waiting := [worker for worker in self._workers if worker.due]:
                self._receive(waiting)
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """End the workers. The memory is freed when the last array that views it is deleted."""
        self._end()
        self._workers, self._pictures = [], {}

    def _start(self) -> None:
        """Create the shared memory and start the workers, unless they run already."""
        if self.running:
            return
        self.close()  # in a forked child, forgets the workers of the parent
        descriptor = create_memory(self._cars, self._formats)
        self._owner, workers = os.getpid(), self._workers
        self._end = weakref.finalize(self, _end, workers, self._owner)
        try:
            self._pictures = map_pictures(descriptor, self._cars, self._formats)
            for number in range(len(self._bounds) - 1):
                cars = range(*self._bounds[number : number + 2])
                workers.append(self._start_worker(number, cars, descriptor))
        finally:
            os.close(descriptor)

    def _start_worker(self, number: int, cars: range, descriptor: int) -> _Worker:
        """Start worker `number`, which draws the cars `cars`, and send it its setup. It inherits
        the shared memory with the file `descriptor`."""
        mine, theirs = socket.socketpair()
        # A stopped worker reads nothing, so sending must have a time limit.
        mine.setsockopt(socket.SOL_SOCKET, socket.SO_SNDTIMEO, struct.pack("ll", SILENCE_S, 0))
        with theirs:
            process = subprocess.Popen(
                [
                    *(sys.executable, "-P", "-m", MODULE),
                    *map(str, (theirs.fileno(), descriptor, os.getpid())),
                ],
                env={
                    **os.environ,
                    **thread_limits(len(self._bounds) - 1),
                    "PYTHONPATH": os.pathsep.join(sys.path),
                },
                stdin=subprocess.DEVNULL,
                pass_fds=(theirs.fileno(), descriptor),
                start_new_session=True,  # so that Ctrl-C reaches only the parent
            )
        worker = _Worker(number, process, Connection(mine.detach()), cars)
        cameras = max(KEPT_CAMERAS, len(cars))
        self._put(worker, Setup(self._cars, self._formats, self._camera, cameras))
        return worker

    def _send(self, worker: _Worker, shots: list[Shot], views: tuple[str, ...]) -> None:
        """Send a worker its shots, and the sceneries that it has not received yet."""
        new = {shot.scenery for shot in shots} - worker.sceneries
        task = Task(shots, views, {number: self._sceneries[number] for number in new})
        self._put(worker, task)
        worker.sceneries |= new
        worker.due, worker.heard = {shot.car for shot in shots}, monotonic()

    def _put(self, worker: _Worker, message: Setup | Task) -> None:
        """Send a message to a worker. Raises PictureWorkerError if it has ended or hangs."""
        try:
            worker.connection.send(message)
        except BlockingIOError:
            raise self._silence(worker) from None
        except ConnectionError:
            raise self._death(worker) from None

    def _receive(self, waiting: list[_Worker]) -> None:
        """Wait for an answer of one of the workers `waiting`, and process all answers that have
        arrived."""
        due = min(worker.heard for worker in waiting) + SILENCE_S
        ready = set(wait([worker.connection for worker in waiting], max(due - monotonic(), 0.0)))
        for worker in waiting:
            if worker.connection not in ready:
                if monotonic() - worker.heard >= SILENCE_S:
                    raise self._silence(worker)
                continue
            try:
                answer: int | UserError = worker.connection.recv()
            except (EOFError, ConnectionError):
                raise self._death(worker) from None
            if isinstance(answer, UserError):
                raise answer
            worker.due.discard(answer)
            worker.heard = monotonic()

    def _death(self, worker: _Worker) -> PictureWorkerError:
        return PictureWorkerError(f"{self._name(worker)} {_how(worker.process)}; {NEXT}")

    def _silence(self, worker: _Worker) -> PictureWorkerError:
        return PictureWorkerError(f"{self._name(worker)} drew no picture for {SILENCE_S} s; {NEXT}")

    def _name(self, worker: _Worker) -> str:
        first, last = worker.cars[0], worker.cars[-1]
        cars = f"car {first}" if first == last else f"cars {first} to {last}"
        return (
            f"picture worker {worker.number} of {len(self._bounds) - 1} "
            f"(process {worker.process.pid}, {cars})"
        )


def _nothing() -> None:
    """Do nothing. This is the finaliser of a pool without workers."""


NEXT = "all picture workers have been ended, and reset() starts new ones"


def _how(process: "subprocess.Popen[bytes]") -> str:
    """Describe how a process that closed its connection ended, for example "ended with exit code
    1"."""
    try:
        code = process.wait(END_S)
    except subprocess.TimeoutExpired:
        return "closed its connection"
    if code >= 0:
        return f"ended with exit code {code}"
    memory = ", as the system does when memory is short" if code == -signal.SIGKILL else ""
    return f"was killed by {signal.Signals(-code).name}{memory}"


def _end(workers: list[_Worker], owner: int) -> None:
    """Kill and reap the workers. `owner` is the id of the process that started them; in a process
    forked from it, only close the forked process's copies of the connections."""
    for worker in workers:
        worker.connection.close()
        if owner == os.getpid():
            worker.process.kill()
    for worker in workers:
        if owner == os.getpid():
            worker.process.wait()
    workers.clear()
