"""Records rounds on a Ray cluster and moves their files into one folder on this machine.

datagen collect --executor ray        # on the cluster at $RAY_ADDRESS, else on this machine

An actor records on its machine's own disk and returns the file as bytes: no shared disk is needed.
Every machine needs this program, and the track files unless they are the project's own.
"""

import hashlib
import os
import shutil
import tempfile
from collections.abc import Iterable
from dataclasses import dataclass, replace
from os import cpu_count
from pathlib import Path
from time import monotonic, sleep
from typing import Any
from uuid import uuid4

from datagen.execution.retry import Failure, OnMessage, RetryQueue, Timeouts
from datagen.recorder.job import AttemptFailed, FramesDone, Job, Outcome, RoundDone, attempt
from datagen.recording.folder import discard_partial, partial_path, prepare, publish
from runtime.worker_threads import thread_limits
from trackfeatures.errors import UserError

POLL_S = 0.5


class Recorder:
    """The Ray actor. Its main thread records; another thread answers `heartbeat`. The names of its
    temporary folders begin with `prefix`."""

    def __init__(self, prefix: str) -> None:
        from datagen.recorder.job import warm_up

        self._prefix = prefix
        self._heartbeats = 0
        self._frames = 0
        warm_up()

    def record(self, job: Job) -> tuple[Outcome, bytes]:
        """Try to record a round. Returns the outcome and the file's bytes (empty on failure)."""
        self._frames = 0
        with tempfile.TemporaryDirectory(prefix=self._prefix) as home:
            prepare(Path(home))
            ending = attempt(replace(job, folder=Path(home)), self._report)
            if not isinstance(ending, RoundDone):
                return ending, b""
            return ending, (Path(home) / ending.state.file).read_bytes()

    def heartbeat(self) -> tuple[int, int]:
        """Return the number of progress messages since the actor started, and the number of frames
        recorded so far in its current round."""
        return self._heartbeats, self._frames

    def _report(self, message: FramesDone) -> None:
        self._heartbeats += 1
        self._frames = message.frames


@dataclass
class ActorSlot:
    """One actor and the round that it records."""

    actor: Any
    job: Job | None = None
    result: Any = None
    heartbeat: Any = None
    heartbeats: int = -1
    started: float | None = None
    """Monotonic time (s) of the first heartbeat in this job; None before it, because an actor can
    wait long for a free machine."""
    last_heartbeat: float = 0.0

    def deadline(self, timeouts: Timeouts) -> float:
        if self.started is None:
            return float("inf")
        return timeouts.deadline(self.job, self.started, self.last_heartbeat)


class RayPool:
    """Records rounds with `size` actors (0: one per core of the cluster). `on_message` is called
    with the number of frames recorded so far in a running round, and with each finished round."""

    def __init__(self, size: int, on_message: OnMessage, timeouts: Timeouts | None = None) -> None:
        self._ray = _import_ray()
        self._size = size
        self._on_message = on_message
        self._timeouts = timeouts or Timeouts()
        self._slots: list[ActorSlot] = []
        self._queue = RetryQueue((), self._timeouts, on_message)
        self._prefix = f"datagen-{uuid4().hex}-"

    def run(self, jobs: Iterable[Job]) -> list[Failure]:
        """Record the rounds of `jobs`; return the rounds that could not be recorded.

        Raises UserError without a Ray cluster, and UserError or OSError for an error that would
        stop every round.
        """
        self._queue = RetryQueue(jobs, self._timeouts, self._on_message)
        if not self._queue:
            return []
        started_here = self._connect()
        try:
            size = self._size or int(self._ray.cluster_resources().get("CPU", 1))
            for _ in range(min(size, len(self._queue))):
                self._slots.append(self._start_worker())
            while self._assign():
                self._receive()
                self._poll_heartbeats()
                self._kill_hung_workers()
        finally:
            for slot in self._slots:
                self._ray.kill(slot.actor)
            self._slots = []
            if started_here:
                self._ray.shutdown()
            self._remove_temporary_folders()
        return self._queue.failures

    def _connect(self) -> bool:
        """Join the cluster at $RAY_ADDRESS, or start one on this machine. Returns False if this
        process was already connected."""
        if self._ray.is_initialized():
            return False
        # Never search for a cluster: a cluster found by chance may belong to another collection.
        address = os.environ.get("RAY_ADDRESS", "local")
        cores = {"num_cpus": max(self._size, cpu_count() or 1)} if address == "local" else {}
        try:
            self._ray.init(
                address=address,
                **cores,
                include_dashboard=False,
                logging_level="ERROR",
                log_to_driver=False,
            )
        except (ConnectionError, RuntimeError, ValueError, OSError) as error:
            raise UserError(
                f"no Ray cluster could be joined or started ({error}); set RAY_ADDRESS to one, or "
                "leave --executor ray out"
            ) from error
        return True

    def _start_worker(self) -> ActorSlot:
        recorder = self._ray.remote(
            num_cpus=1,
            max_restarts=0,
            concurrency_groups={"heartbeat": 1},
            runtime_env={"env_vars": thread_limits(cpu_count() or 1)},
        )(Recorder)
        return ActorSlot(recorder.remote(self._prefix))

    def _remove_temporary_folders(self) -> None:
        """Remove the folders that killed actors have left on this machine."""
        for folder in Path(tempfile.gettempdir()).glob(f"{self._prefix}*"):
            shutil.rmtree(folder, ignore_errors=True)

    def _assign(self) -> bool:
        for slot in self._slots:
            if slot.job is None:
                slot.job = self._queue.take(monotonic())
                if slot.job is None:
                    break
                slot.started, slot.heartbeats = None, -1
                slot.result = slot.actor.record.remote(slot.job)
        return bool(self._queue) or any(slot.job is not None for slot in self._slots)

    def _receive(self) -> None:
        results = [slot.result for slot in self._slots if slot.job is not None]
        if not results:  # all remaining rounds wait for their next attempt
            sleep(min(max(self._queue.next_at() - monotonic(), 0.0), POLL_S))
            return
        ready, _ = self._ray.wait(results, timeout=POLL_S)
        for slot in self._slots:
            if slot.job is None or slot.result not in ready:
                continue
            try:
                ending, data = self._ray.get(slot.result)
            except self._ray.exceptions.RayError as error:
                self._replace(slot, f"its actor ended ({_first_line(error)})")
            else:
                job, slot.job = slot.job, None
                self._queue.record_outcome(job, _received(job, ending, data))

    def _poll_heartbeats(self) -> None:
        for slot in self._slots:
            if slot.job is None:
                continue
            if slot.heartbeat is None:
                slot.heartbeat = slot.actor.heartbeat.options(
                    concurrency_group="heartbeat"
                ).remote()
                continue
            if not self._ray.wait([slot.heartbeat], timeout=0)[0]:
                continue
            heartbeat, slot.heartbeat = slot.heartbeat, None
            try:
                heartbeats, frames = self._ray.get(heartbeat)
            except self._ray.exceptions.RayError:
                continue  # `_receive` handles the ended actor
            now = monotonic()
            if slot.started is None:
                slot.started = slot.last_heartbeat = now
            if heartbeats != slot.heartbeats:
                slot.heartbeats, slot.last_heartbeat = heartbeats, now
                self._on_message(FramesDone(slot.job.plan.id, frames))

    def _kill_hung_workers(self) -> None:
        now = monotonic()
        for slot in self._slots:
            if now >= slot.deadline(self._timeouts):
                self._ray.kill(slot.actor)
                spent = self._timeouts.spent(now, slot.started or now, slot.last_heartbeat)
                self._replace(slot, f"its actor {spent}")

    def _replace(self, slot: ActorSlot, reason: str) -> None:
        self._queue.record_death(slot.job, reason)
        slot.actor, slot.job, slot.heartbeat = self._start_worker().actor, None, None


def _received(job: Job, ending: Outcome, data: bytes) -> Outcome:
    """Move `data`, the bytes of a finished round, into the dataset folder. Return the outcome
    `ending`, or AttemptFailed if the bytes were damaged in transfer."""
    if not isinstance(ending, RoundDone):
        return ending
    if hashlib.sha256(data).hexdigest() != ending.state.sha256:
        return AttemptFailed(job.plan.id, "its bytes were damaged in transfer")
    partial = partial_path(job.folder, job.plan.id)
    try:
        partial.write_bytes(data)
        publish(job.folder, partial, ending.state)
    finally:
        discard_partial(job.folder, job.plan.id)
    return ending


def _first_line(error: Exception) -> str:
    return next(iter(str(error).splitlines()), type(error).__name__)


def _import_ray() -> Any:
    try:
        import ray
    except ImportError as error:
        raise UserError(
            "--executor ray needs Ray, which is not installed; install it with: pip install ray"
        ) from error
    return ray
