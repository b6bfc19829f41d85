"""The queue of rounds to record and to record again after a failure, for all executors."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from time import monotonic

from datagen.recorder.job import AttemptFailed, FatalError, FramesDone, Job, Outcome, RoundDone
from datagen.recording.errors import DatasetError

OnMessage = Callable[[FramesDone | RoundDone], None]

ATTEMPTS = 3
DEATHS_IN_A_ROW = 12
"""The collection stops after this many process deaths without a finished round between them."""


@dataclass(frozen=True, slots=True)
class Timeouts:
    """Time limits and delays of an executor, in s."""

    heartbeat_s: float = 300.0
    """A process that has sent no message for this time (s) counts as hanging and is stopped. The
    time is long, because a process sends no messages while it compiles its functions."""
    round_start_s: float = 600.0
    frame_s: float = 1.0
    """A round may take `round_start_s` plus this time for each frame."""
    retry_delay_s: float = 1.0
    """Delay before the second attempt. The delay before the third attempt is four times as long."""

    def deadline(self, job: Job | None, started: float, last_heartbeat: float) -> float:
        """Return the time (s) at which a process that records `job` is stopped; infinite if `job`
        is None. The process began the job at `started` and sent its last message at
        `last_heartbeat`. All times are monotonic, in s."""
        if job is None:
            return float("inf")
        round_s = self.round_start_s + self.frame_s * job.plan.frames
        return min(last_heartbeat + self.heartbeat_s, started + round_s)

    def spent(self, now: float, started: float, last_heartbeat: float) -> str:
        """Return text that states which time limit a process has exceeded at the time `now`.
        `started` is the start of its job, `last_heartbeat` the arrival of its last message. All
        times are monotonic, in s."""
        silent_s = now - last_heartbeat
        if silent_s >= self.heartbeat_s:
            return f"gave no sign of life for {silent_s:.0f} s"
        return f"did not finish the round in {now - started:.0f} s"


@dataclass(frozen=True, slots=True)
class Failure:
    round_id: str
    reason: str
    final: bool
    """True if another attempt would fail in the same way."""


class RetryQueue:
    """The rounds that wait to be recorded, each with the earliest time of its next attempt.

    `on_message` is called for each finished round, and with 0 frames for each failed attempt.
    """

    def __init__(self, jobs: Iterable[Job], timeouts: Timeouts, on_message: OnMessage) -> None:
        self._waiting = [(0.0, job) for job in jobs]
        self._timeouts = timeouts
        self._on_message = on_message
        self._attempts: dict[str, int] = {}
        self._deaths = 0
        self.failures: list[Failure] = []

    def __len__(self) -> int:
        return len(self._waiting)

    def take(self, now: float) -> Job | None:
        """Remove and return the first round whose next attempt is due at `now` (s); None if no
        attempt is due."""
        for place, (not_before, job) in enumerate(self._waiting):
            if not_before <= now:
                del self._waiting[place]
                return job
        return None

    def next_at(self) -> float:
        """Return the monotonic time (s) of the earliest next attempt; infinite if no round
        waits."""
        return min((not_before for not_before, _ in self._waiting), default=float("inf"))

    def record_outcome(self, job: Job, outcome: Outcome) -> None:
        """Handle the outcome of an attempt: pass a finished round to `on_message`, queue a failed
        round again, or raise the error that stops the whole collection."""
        if isinstance(outcome, FatalError):
            raise outcome.error
        if isinstance(outcome, AttemptFailed):
            self.record_failure(job, outcome.reason, monotonic(), outcome.final)
            return
        self._deaths = 0
        self._on_message(outcome)

    def record_death(self, job: Job | None, reason: str) -> None:
        """Count a recording process that ended unexpectedly, and queue its round `job` again.
        `reason` describes the end of the process, for messages.

        Raises DatasetError when 12 processes (DEATHS_IN_A_ROW) have ended without a finished round
        in between.
        """
        self._deaths += 1
        if self._deaths >= DEATHS_IN_A_ROW:
            raise DatasetError(
                f"{self._deaths} recording processes ended one after the other without a finished "
                f"round (the last one: {reason}); the rounds finished before can be used"
            )
        if job is not None:
            self.record_failure(job, reason, monotonic())

    def record_failure(self, job: Job, reason: str, now: float, final: bool = False) -> None:
        """Queue the round of `job` for another attempt after a delay. Instead, add it to `failures`
        with `reason` if this was the third attempt (ATTEMPTS) or `final` is true. `now` is the
        monotonic time in s."""
        self._on_message(FramesDone(job.plan.id, 0))
        attempts = self._attempts[job.plan.id] = self._attempts.get(job.plan.id, 0) + 1
        if attempts < ATTEMPTS and not final:
            delay = self._timeouts.retry_delay_s * 4.0 ** (attempts - 1)
            self._waiting.append((now + delay, job))
        else:
            self.failures.append(Failure(job.plan.id, reason, final))
