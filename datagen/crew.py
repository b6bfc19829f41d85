"""Several recording processes at once; one that dies costs its round, and the round is retried."""

import multiprocessing
import os
import signal
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess

from datagen.worker import FramesDone, Hopeless, Job, Message, RoundBroken, RoundDone, work

ATTEMPTS = 3
STOP_S = 5.0
CONTEXT = multiprocessing.get_context("spawn")  # a forked graphics context does not work


@dataclass
class Worker:
    process: BaseProcess
    connection: Connection
    job: Job | None = None


@dataclass(frozen=True, slots=True)
class Failure:
    round_id: str
    reason: str
    final: bool  # the same round will fail again


class Crew:
    """`size` processes. `hear` gets FramesDone and RoundDone as they come; see `run`."""

    def __init__(self, size: int, hear: Callable[[FramesDone | RoundDone], None]) -> None:
        self._size = size
        self._hear = hear
        self._workers: list[Worker] = []
        self._attempts: dict[str, int] = {}
        self._jobs: deque[Job] = deque()
        self.failures: list[Failure] = []

    def run(self, jobs: Iterable[Job]) -> list[Failure]:
        """Record all rounds; those that failed for good, or ATTEMPTS times, are returned.

        Raises what no round can get round (disk full, unknown track): UserError or OSError. Leaves
        no process behind, however it ends.
        """
        self._jobs = deque(jobs)
        try:
            with _single_threaded(self._size):
                self._workers = [self._hire() for _ in range(min(self._size, len(self._jobs)))]
                while self._assign():
                    self._listen()
        finally:
            self._dismiss()
        return self.failures

    def _hire(self) -> Worker:
        mine, theirs = CONTEXT.Pipe()
        process = CONTEXT.Process(target=work, args=(theirs,), daemon=True)
        # A new process keeps ignoring what is ignored here: Ctrl-C is for this one to handle.
        before = signal.signal(signal.SIGINT, signal.SIG_IGN)
        try:
            process.start()
        finally:
            signal.signal(signal.SIGINT, before)
        theirs.close()
        return Worker(process, mine)

    def _assign(self) -> bool:
        """Give idle workers something to do; False when all is done."""
        for worker in self._workers:
            if worker.job is None and self._jobs:
                worker.job = self._jobs.popleft()
                try:
                    worker.connection.send(worker.job)
                except BrokenPipeError:
                    continue  # it has died: `_listen` will see
        return any(worker.job is not None for worker in self._workers)

    def _listen(self) -> None:
        ready = set(wait([worker.connection for worker in self._workers]))
        for number, worker in enumerate(self._workers):
            if worker.connection not in ready:
                continue
            try:
                message: Message = worker.connection.recv()
            except (EOFError, ConnectionResetError):
                self._bury(number)
            else:
                self._take(worker, message)

    def _take(self, worker: Worker, message: Message) -> None:
        if isinstance(message, Hopeless):
            raise message.error
        if isinstance(message, RoundBroken):
            self._retry(worker, message.reason, message.final)
        else:
            if isinstance(message, RoundDone):
                worker.job = None
            self._hear(message)

    def _bury(self, number: int) -> None:
        """A worker died: put another in its place."""
        dead = self._workers[number]
        dead.connection.close()
        dead.process.join()
        self._workers[number] = self._hire()
        if dead.job is not None:
            self._retry(dead, f"its process ended with code {dead.process.exitcode}")

    def _retry(self, worker: Worker, reason: str, final: bool = False) -> None:
        job, worker.job = worker.job, None
        if job is None:
            return
        tried = self._attempts[job.plan.id] = self._attempts.get(job.plan.id, 0) + 1
        self._hear(FramesDone(job.plan.id, 0))
        if tried < ATTEMPTS and not final:
            self._jobs.append(job)
        else:
            self.failures.append(Failure(job.plan.id, reason, final))

    def _dismiss(self) -> None:
        """Idle workers are asked to go, busy ones are stopped."""
        for worker in self._workers:
            if worker.job is not None or not worker.process.is_alive():
                worker.process.terminate()
                continue
            try:
                worker.connection.send(None)
            except BrokenPipeError:
                worker.process.terminate()
        for worker in self._workers:
            worker.process.join(STOP_S)
            if worker.process.is_alive():
                worker.process.kill()
                worker.process.join()
            worker.connection.close()
        self._workers = []


@contextmanager
def _single_threaded(workers: int) -> Iterator[None]:
    """Each process gets its share of the cores: libraries that start threads of their own read
    these variables when they are loaded, so they are set before the processes start."""
    share = (os.cpu_count() or 1) // workers
    wanted = {
        "LP_NUM_THREADS": str(share if share > 1 else 0),
        "OMP_NUM_THREADS": "1",
        "OPENBLAS_NUM_THREADS": "1",
    }
    before = {name: os.environ.get(name) for name in wanted}
    os.environ.update(wanted)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value
