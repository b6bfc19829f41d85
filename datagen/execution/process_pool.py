"""Several recording processes at once; one that dies or hangs costs its round, which is retried."""

import multiprocessing
import os
import signal
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from time import monotonic

from datagen.execution.retry import Failure, Limits, Tries
from datagen.recorder.job import FatalError, FramesDone, Job, Message, RoundBroken, RoundDone, work

STOP_S = 5.0
CONTEXT = multiprocessing.get_context("spawn")  # a forked graphics context does not work

Hear = Callable[[FramesDone | RoundDone], None]


@dataclass
class Worker:
    process: BaseProcess
    connection: Connection
    job: Job | None = None
    since: float = 0.0
    heard: float = 0.0

    def deadline(self, limits: Limits) -> float:
        if self.job is None:
            return float("inf")
        return min(self.heard + limits.silence_s, self.since + limits.round_s(self.job))


class ProcessPool:
    """`size` processes (0: one a core). `hear` gets FramesDone and RoundDone as they come."""

    def __init__(self, size: int, hear: Hear, limits: Limits | None = None) -> None:
        self._size = size or os.cpu_count() or 1
        self._hear = hear
        self._limits = limits or Limits()
        self._workers: list[Worker] = []
        self._tries = Tries((), self._limits)

    def run(self, jobs: Iterable[Job]) -> list[Failure]:
        """Record all rounds; those that failed for good, or too often, are returned.

        Raises what no round can get round (disk full, unknown track): UserError or OSError. Leaves
        no process behind, however it ends.
        """
        self._tries = Tries(jobs, self._limits)
        try:
            with _single_threaded(self._size):
                for _ in range(min(self._size, len(self._tries))):
                    self._workers.append(self._hire())
                while self._assign():
                    self._listen()
                    self._end_the_stuck()
        finally:
            self._dismiss()
        return self._tries.failures

    def _hire(self) -> Worker:
        mine, theirs = CONTEXT.Pipe()
        process = CONTEXT.Process(target=work, args=(theirs, os.getpid()), daemon=True)
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
            if worker.job is not None:
                continue
            worker.since = worker.heard = monotonic()
            worker.job = self._tries.take(worker.since)
            if worker.job is None:
                break
            try:
                worker.connection.send(worker.job)
            except BrokenPipeError:
                continue  # it has died: `_listen` will see
        return bool(self._tries) or any(worker.job is not None for worker in self._workers)

    def _listen(self) -> None:
        """Hear what there is to hear until the next thing is due."""
        idle = any(worker.job is None for worker in self._workers)
        due = min(worker.deadline(self._limits) for worker in self._workers)
        due = min(due, self._tries.next_at() if idle else due)
        patience = max(due - monotonic(), 0.0)
        ready = set(wait([worker.connection for worker in self._workers], patience))
        for number, worker in enumerate(self._workers):
            if worker.connection not in ready:
                continue
            try:
                message: Message = worker.connection.recv()
            except (EOFError, ConnectionResetError):
                self._replace(number, f"its process ended with code {_code(worker.process)}")
            else:
                worker.heard = monotonic()
                self._take(worker, message)

    def _end_the_stuck(self) -> None:
        now = monotonic()
        for number, worker in enumerate(self._workers):
            if worker.job is None or now < worker.deadline(self._limits):
                continue
            silent = now - worker.heard >= self._limits.silence_s
            worker.process.kill()  # a stopped one would not hear anything gentler
            spent = now - (worker.heard if silent else worker.since)
            what = "its process gave no sign of life" if silent else "it was not finished"
            self._replace(number, f"{what} for {spent:.0f} s")

    def _take(self, worker: Worker, message: Message) -> None:
        if isinstance(message, FatalError):
            raise message.error
        if isinstance(message, RoundBroken):
            self._retry(worker, message.reason, message.final)
            return
        if isinstance(message, RoundDone):
            worker.job = None
            self._tries.done()
        self._hear(message)

    def _replace(self, number: int, reason: str) -> None:
        """A worker is dead: put another in its place."""
        dead = self._workers[number]
        dead.connection.close()
        dead.process.join()
        self._tries.died(reason)
        self._workers[number] = self._hire()
        self._retry(dead, reason)

    def _retry(self, worker: Worker, reason: str, final: bool = False) -> None:
        job, worker.job = worker.job, None
        if job is not None:
            self._hear(FramesDone(job.plan.id, 0))
            self._tries.failed(job, reason, monotonic(), final)

    def _dismiss(self) -> None:
        """Idle workers are asked to go, busy ones are stopped."""
        for worker in self._workers:
            if worker.connection.closed:
                continue
            if worker.job is not None or not worker.process.is_alive():
                worker.process.kill()
                continue
            try:
                worker.connection.send(None)
            except BrokenPipeError:
                worker.process.kill()
        for worker in self._workers:
            worker.process.join(STOP_S)
            if worker.process.is_alive():
                worker.process.kill()
                worker.process.join()
            worker.connection.close()
        self._workers = []


def _code(process: BaseProcess) -> int | None:
    process.join(STOP_S)
    return process.exitcode


@contextmanager
def _single_threaded(workers: int) -> Iterator[None]:
    """Each process gets its share of the cores: libraries that start threads of their own read
    these variables when they are loaded, so they are set before the processes start."""
    wanted = thread_limits(workers)
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


def thread_limits(workers: int) -> dict[str, str]:
    """Environment variables for each of `workers` processes on this machine."""
    share = (os.cpu_count() or 1) // workers
    return {
        "LP_NUM_THREADS": str(share if share > 1 else 0),
        "OMP_NUM_THREADS": "1",
        "OPENBLAS_NUM_THREADS": "1",
    }
