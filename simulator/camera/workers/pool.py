"""Worker processes that draw the pictures of many cars; each worker draws the pictures of its own
cars.

The workers are new interpreters, neither forked nor imported from the user's script: OpenGL does
not survive a fork, and a script needs no `if __name__ == "__main__"`.
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
"""Longest wait (s) for one picture, which may need a new scene: one takes seconds to build."""
END_S = 5.0
KEPT_CAMERAS = 8
"""Cameras that a worker keeps at least: on random roads, cars come back to earlier ones."""
MODULE = "simulator.camera.workers.worker"


class PictureWorkerError(UserError):
    """A worker process has ended or hangs, so that there are no pictures."""


@dataclass(eq=False)
class _Worker:
    """A worker process and the connection to it; its cars, the sceneries that it was sent, and the
    cars whose pictures it has yet to draw (`due`)."""

    number: int
    process: "subprocess.Popen[bytes]"
    connection: Connection
    cars: range
    sceneries: set[int] = field(default_factory=set)
    due: set[int] = field(default_factory=set)
    heard: float = 0.0
    """Time of the last sign of life while pictures are due."""


class PicturePool:
    """Draws pictures of `cars` cars in `workers` processes.

    `formats`: the picture of one car, by the name of its view. The processes start with the first
    picture. An error, Ctrl-C or `close` ends the processes and frees their shared memory; the next
    picture starts new processes.
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
        """The views that have room in the shared memory."""
        return tuple(self._formats)

    @property
    def running(self) -> bool:
        """Whether this process has started workers. Workers of the process that it was forked from
        do not count."""
        return bool(self._workers) and self._owner == os.getpid()

    def number_of(self, scenery: Scenery) -> int:
        """The number of a scenery in a `Shot`; each scenery is sent to a worker once."""
        key = (id(scenery.road), scenery.light, scenery.light_seed)  # the list keeps the road alive
        if key not in self._numbers:
            self._numbers[key] = len(self._sceneries)
            self._sceneries.append(scenery)
        return self._numbers[key]

    def pictures(self, view: str) -> NDArray[Any]:
        """The pictures (cars, *shape) of `view` in the shared memory; a car that was never drawn is
        all zeros."""
        self._start()
        return self._pictures[view]

    def draw(self, shots: Sequence[Shot], views: tuple[str, ...]) -> None:
        """Draw `views` of each shot's car. Raises PictureWorkerError, which names the worker, when
        one dies or hangs, and the UserError of a worker that cannot draw."""
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
        """End the workers; the memory is freed with the last array that views it."""
        self._end()
        self._workers, self._pictures = [], {}

    def _start(self) -> None:
        if self.running:
            return
        self.close()  # in a forked child: the workers are the parent's
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
        mine, theirs = socket.socketpair()
        # A stopped worker reads nothing, so sending to it must not wait for ever.
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
                start_new_session=True,  # Ctrl-C is for the parent alone
            )
        worker = _Worker(number, process, Connection(mine.detach()), cars)
        cameras = max(KEPT_CAMERAS, len(cars))
        self._put(worker, Setup(self._cars, self._formats, self._camera, cameras))
        return worker

    def _send(self, worker: _Worker, shots: list[Shot], views: tuple[str, ...]) -> None:
        new = {shot.scenery for shot in shots} - worker.sceneries
        task = Task(shots, views, {number: self._sceneries[number] for number in new})
        self._put(worker, task)
        worker.sceneries |= new
        worker.due, worker.heard = {shot.car for shot in shots}, monotonic()

    def _put(self, worker: _Worker, message: Setup | Task) -> None:
        try:
            worker.connection.send(message)
        except BlockingIOError:
            raise self._silence(worker) from None
        except ConnectionError:
            raise self._death(worker) from None

    def _receive(self, waiting: list[_Worker]) -> None:
        """Wait for an answer, and take those that have come."""
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
    """Do nothing: the finaliser of a pool that has no workers."""


NEXT = "all picture workers have been ended, and reset() starts new ones"


def _how(process: "subprocess.Popen[bytes]") -> str:
    """A text about how a process ended that has closed its connection."""
    try:
        code = process.wait(END_S)
    except subprocess.TimeoutExpired:
        return "closed its connection"
    if code >= 0:
        return f"ended with exit code {code}"
    memory = ", as the system does when memory is short" if code == -signal.SIGKILL else ""
    return f"was killed by {signal.Signals(-code).name}{memory}"


def _end(workers: list[_Worker], owner: int) -> None:
    """Kill and reap the workers; a forked child closes its copies of the connections only."""
    for worker in workers:
        worker.connection.close()
        if owner == os.getpid():
            worker.process.kill()
    for worker in workers:
        if owner == os.getpid():
            worker.process.wait()
    workers.clear()
