"""Recording on a Ray cluster: the same rounds by the same code, gathered into one folder here.

datagen collect --executor ray        # $RAY_ADDRESS names the cluster; without one, this machine

A round is recorded on the other machine's own disk and comes back as bytes, so that no disk need
be shared. Every machine needs this program, and the tracks where they are not the project's own.
"""

import hashlib
import tempfile
from collections.abc import Iterable
from dataclasses import dataclass, replace
from os import cpu_count
from pathlib import Path
from time import monotonic
from typing import Any

from datagen.execution.process_pool import Hear, thread_limits
from datagen.execution.retry import Failure, Limits, Tries
from datagen.recorder.job import (
    Ending,
    FatalError,
    FramesDone,
    Job,
    RoundBroken,
    RoundDone,
    attempt,
)
from datagen.recording.folder import discard_partial, partial_path, prepare, publish
from trackfeatures.errors import UserError

PULSE_S = 0.5


class Recorder:
    """The actor: records in its main thread, and answers from another one how far it is."""

    def __init__(self) -> None:
        from datagen.recorder.job import warm_up

        self._signs = 0
        self._frames = 0
        warm_up()

    def record(self, job: Job) -> tuple[Ending, bytes]:
        """The round's file comes with RoundDone, else nothing does."""
        with tempfile.TemporaryDirectory(prefix="datagen-") as home:
            prepare(Path(home))
            ending = attempt(replace(job, folder=Path(home)), self._report)
            if not isinstance(ending, RoundDone):
                return ending, b""
            return ending, (Path(home) / ending.state.file).read_bytes()

    def pulse(self) -> tuple[int, int]:
        """Signs of life so far, and frames of the present round."""
        return self._signs, self._frames

    def _report(self, message: FramesDone) -> None:
        self._signs += 1
        self._frames = message.frames


@dataclass
class Seat:
    """One actor and what it is doing."""

    actor: Any
    job: Job | None = None
    result: Any = None
    pulse: Any = None
    signs: int = -1
    since: float | None = None
    """When it was first heard of with this job; an actor may wait long for its machine."""
    heard: float = 0.0

    def deadline(self, limits: Limits) -> float:
        if self.job is None or self.since is None:
            return float("inf")
        return min(self.heard + limits.silence_s, self.since + limits.round_s(self.job))


class RayCrew:
    """`size` actors (0: one a core of the cluster); the same `run` as `crew.ProcessPool`."""

    def __init__(self, size: int, hear: Hear, limits: Limits | None = None) -> None:
        self._ray = _import_ray()
        self._size = size
        self._hear = hear
        self._limits = limits or Limits()
        self._seats: list[Seat] = []
        self._tries = Tries((), self._limits)

    def run(self, jobs: Iterable[Job]) -> list[Failure]:
        """Record all rounds; those that failed for good, or too often, are returned.

        Raises UserError without Ray's cluster, and what no round can get round.
        """
        self._tries = Tries(jobs, self._limits)
        if not self._tries:
            return []
        started_here = self._connect()
        try:
            size = self._size or int(self._ray.cluster_resources().get("CPU", 1))
            for _ in range(min(size, len(self._tries))):
                self._seats.append(self._hire())
            while self._assign():
                self._gather()
                self._feel_pulses()
                self._end_the_stuck()
        finally:
            for seat in self._seats:
                self._ray.kill(seat.actor)
            self._seats = []
            if started_here:
                self._ray.shutdown()
        return self._tries.failures

    def _connect(self) -> bool:
        """Join the cluster, or start one here; False when this process was in one already."""
        if self._ray.is_initialized():
            return False
        try:
            try:
                self._ray.init(address="auto", logging_level="ERROR", log_to_driver=False)
            except ConnectionError:
                self._ray.init(
                    address="local",
                    num_cpus=max(self._size, cpu_count() or 1),
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

    def _hire(self) -> Seat:
        recorder = self._ray.remote(
            num_cpus=1,
            max_restarts=0,
            concurrency_groups={"watching": 1},
            runtime_env={"env_vars": thread_limits(cpu_count() or 1)},
        )(Recorder)
        return Seat(recorder.remote())

    def _assign(self) -> bool:
        for seat in self._seats:
            if seat.job is None:
                seat.job = self._tries.take(monotonic())
                if seat.job is None:
                    break
                seat.since, seat.signs = None, -1
                seat.result = seat.actor.record.remote(seat.job)
        return bool(self._tries) or any(seat.job is not None for seat in self._seats)

    def _gather(self) -> None:
        busy = [seat for seat in self._seats if seat.job is not None]
        ready, _ = self._ray.wait([s.result for s in busy], timeout=PULSE_S) if busy else ([], [])
        for seat in busy:
            if seat.result not in ready:
                continue
            try:
                ending, data = self._ray.get(seat.result)
            except self._ray.exceptions.RayError as error:
                self._replace(seat, f"its actor ended ({_first_line(error)})")
            else:
                self._take(seat, ending, data)

    def _take(self, seat: Seat, ending: Ending, data: bytes) -> None:
        if isinstance(ending, FatalError):
            raise ending.error
        if isinstance(ending, RoundBroken):
            self._retry(seat, ending.reason, ending.final)
            return
        if seat.job is None or hashlib.sha256(data).hexdigest() != ending.state.sha256:
            self._retry(seat, "its bytes were damaged on the way")
            return
        _publish(seat.job.folder, ending, data)
        seat.job = None
        self._tries.done()
        self._hear(ending)

    def _feel_pulses(self) -> None:
        for seat in self._seats:
            if seat.job is None:
                continue
            if seat.pulse is None:
                seat.pulse = seat.actor.pulse.options(concurrency_group="watching").remote()
                continue
            if not self._ray.wait([seat.pulse], timeout=0)[0]:
                continue
            pulse, seat.pulse = seat.pulse, None
            try:
                signs, frames = self._ray.get(pulse)
            except self._ray.exceptions.RayError:
                continue  # its result will tell
            now = monotonic()
            if seat.since is None:
                seat.since = seat.heard = now
            if signs != seat.signs:
                seat.signs, seat.heard = signs, now
                self._hear(FramesDone(seat.job.plan.id, frames))

    def _end_the_stuck(self) -> None:
        now = monotonic()
        for seat in self._seats:
            if now >= seat.deadline(self._limits):
                self._ray.kill(seat.actor)
                self._replace(seat, f"nothing was heard of it for {now - seat.heard:.0f} s")

    def _replace(self, seat: Seat, reason: str) -> None:
        self._tries.died(reason)
        seat.actor, seat.pulse = self._hire().actor, None
        self._retry(seat, reason)

    def _retry(self, seat: Seat, reason: str, final: bool = False) -> None:
        job, seat.job = seat.job, None
        if job is not None:
            self._hear(FramesDone(job.plan.id, 0))
            self._tries.failed(job, reason, monotonic(), final)


def _publish(folder: Path, done: RoundDone, data: bytes) -> None:
    partial = partial_path(folder, done.state.id)
    try:
        partial.write_bytes(data)
        publish(folder, partial, done.state)
    finally:
        discard_partial(folder, done.state.id)


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
