"""Records rounds in several processes. If a process ends or hangs, its round is tried again."""

import multiprocessing
import os
import signal
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from time import monotonic

from datagen.execution.retry import Failure, OnMessage, RetryQueue, Timeouts
from datagen.recorder.job import FramesDone, Job, Message, worker_main
from runtime.worker_threads import thread_limits

STOP_S = 5.0  # s: time that a process has to end before it is killed
CONTEXT = multiprocessing.get_context("spawn")  # because graphics contexts do not survive a fork


@dataclass
class Worker:
    process: BaseProcess
    connection: Connection
    job: Job | None = None
    started: float = 0.0
    last_heartbeat: float = 0.0

    def deadline(self, timeouts: Timeouts) -> float:
        return timeouts.deadline(self.job, self.started, self.last_heartbeat)


class ProcessPool:
    """Records rounds in `size` processes (0: one per core). `on_message` is called with the number
    of frames recorded so far in a running round, and with each finished round."""

    def __init__(self, size: int, on_message: OnMessage, timeouts: Timeouts | None = None) -> None:
        self._size = size or os.cpu_count() or 1
        self._on_message = on_message
        self._timeouts = timeouts or Timeouts()
        self._workers: list[Worker] = []
        self._queue = RetryQueue((), self._timeouts, on_message)

    def run(self, jobs: Iterable[Job]) -> list[Failure]:
        """Record the rounds of `jobs`; return the rounds that could not be recorded.

        Raises UserError or OSError for an error that would stop every round (disk full, unknown
        track). All processes have ended when this method returns or raises.
        """
        self._queue = RetryQueue(jobs, self._timeouts, self._on_message)
        count = min(self._size, len(self._queue))
        if not count:
            return []
        try:
            with _limited_threads(count):
                for _ in range(count):
                    with _interrupt_afterwards():
                        self._workers.append(self._start_worker())
                while self._assign():
                    self._receive()
                    self._kill_hung_workers()
        finally:
            self._stop_workers()
        return self._queue.failures

    def _start_worker(self) -> Worker:
        mine, theirs = CONTEXT.Pipe()
        process = CONTEXT.Process(target=worker_main, args=(theirs, os.getpid()), daemon=True)
        process.start()
        theirs.close()
        return Worker(process, mine)

    def _assign(self) -> bool:
        """Give a round to each idle worker; return False when all rounds are done."""
        for worker in self._workers:
            if worker.job is not None:
                continue
            worker.started = worker.last_heartbeat = monotonic()
            worker.job = self._queue.take(worker.started)
            if worker.job is None:
                break
            try:
                worker.connection.send(worker.job)
            except BrokenPipeError:
                continue  # the process has ended: `_receive` replaces it
        return bool(self._queue) or any(worker.job is not None for worker in self._workers)

    def _receive(self) -> None:
        """Wait until a message arrives, a worker's deadline passes or a retry is due; handle the
        messages."""
        idle = any(worker.job is None for worker in self._workers)
        due = min(worker.deadline(self._timeouts) for worker in self._workers)
        due = min(due, self._queue.next_at() if idle else due)
        wait_s = max(due - monotonic(), 0.0)
        ready = set(wait([worker.connection for worker in self._workers], wait_s))
        for number, worker in enumerate(self._workers):
            if worker.connection not in ready:
                continue
            try:
                message: Message = worker.connection.recv()
            except (EOFError, ConnectionResetError):
                self._replace(number, f"its process ended with code {_code(worker.process)}")
            else:
                worker.last_heartbeat = monotonic()
                self._handle(worker, message)

    def _kill_hung_workers(self) -> None:
        now = monotonic()
        for number, worker in enumerate(self._workers):
            if worker.job is None or now < worker.deadline(self._timeouts):
                continue
            worker.process.kill()  # a suspended process does not react to SIGTERM
            spent = self._timeouts.spent(now, worker.started, worker.last_heartbeat)
            self._replace(number, f"its process {spent}")

    def _handle(self, worker: Worker, message: Message) -> None:
        if isinstance(message, FramesDone):
            self._on_message(message)
        elif worker.job is not None:
            job, worker.job = worker.job, None
            self._queue.record_outcome(job, message)

    def _replace(self, number: int, reason: str) -> None:
        """Start a new process for worker `number`, whose process has ended, and queue the round of
        the ended process again. `reason` describes the end, for the error message."""
        ended = self._workers[number]
        ended.connection.close()
        ended.process.join()
        self._queue.record_death(ended.job, reason)
        with _interrupt_afterwards():
            self._workers[number] = self._start_worker()

    def _stop_workers(self) -> None:
        """Ask idle workers to end, and kill busy ones."""
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
def _interrupt_afterwards() -> Iterator[None]:
    """Delay SIGINT (Ctrl-C) until the block has ended. Processes that are started in the block
    inherit the blocked signal: only this process handles Ctrl-C."""
    resource_tracker.ensure_running()  # its start would unblock the signal within the block
    arrived: list[int] = []
    # Another thread can receive the signal; then the handler runs although the signal is blocked.
    before = signal.signal(signal.SIGINT, lambda number, frame: arrived.append(number))
    blocked = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, blocked)
        signal.signal(signal.SIGINT, before)
        if arrived:
            signal.raise_signal(signal.SIGINT)


@contextmanager
def _limited_threads(workers: int) -> Iterator[None]:
    """Set the environment variables of `thread_limits` for `workers` processes within the block.
    Libraries in the child processes read them when they are loaded."""
    limits = thread_limits(workers)
    before = {name: os.environ.get(name) for name in limits}
    os.environ.update(limits)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value
