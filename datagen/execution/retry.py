"""Which rounds are to be recorded, tried again, or given up; the same for every kind of crew."""

from collections.abc import Iterable
from dataclasses import dataclass

from datagen.recorder.job import Job
from datagen.recording.errors import DatasetError

ATTEMPTS = 3
DEATHS_IN_A_ROW = 12
"""So many processes ending without one round finished between them is no accident."""


@dataclass(frozen=True, slots=True)
class Limits:
    """How long to wait, s. Measured by a clock that nobody sets."""

    silence_s: float = 300.0
    """Without a sign of life a process is taken to hang; compiling for the first time is one."""
    start_s: float = 600.0
    frame_s: float = 1.0
    """A round may take `start_s` and this for each frame."""
    delay_s: float = 1.0
    """Before the second try; four times as long before the third."""

    def round_s(self, job: Job) -> float:
        return self.start_s + self.frame_s * job.plan.frames


@dataclass(frozen=True, slots=True)
class Failure:
    round_id: str
    reason: str
    final: bool  # the same round will fail again


class Tries:
    """The rounds that are to do, each with the time before which it is not to be tried."""

    def __init__(self, jobs: Iterable[Job], limits: Limits) -> None:
        self._waiting = [(0.0, job) for job in jobs]
        self._limits = limits
        self._tried: dict[str, int] = {}
        self._deaths = 0
        self.failures: list[Failure] = []

    def __len__(self) -> int:
        return len(self._waiting)

    def take(self, now: float) -> Job | None:
        """The first round whose time has come."""
        for place, (not_before, job) in enumerate(self._waiting):
            if not_before <= now:
                del self._waiting[place]
                return job
        return None

    def next_at(self) -> float:
        """When the next round may be tried; infinite when none waits."""
        return min((not_before for not_before, _ in self._waiting), default=float("inf"))

    def done(self) -> None:
        self._deaths = 0

    def died(self, reason: str) -> None:
        """Raises DatasetError when processes do nothing but die."""
        self._deaths += 1
        if self._deaths >= DEATHS_IN_A_ROW:
            raise DatasetError(
                f"{self._deaths} recording processes ended one after the other and no round was "
                f"finished (the last one: {reason}); what was finished before can be used"
            )

    def failed(self, job: Job, reason: str, now: float, final: bool = False) -> None:
        """Another try later, or none when it was the last or `final`."""
        tried = self._tried[job.plan.id] = self._tried.get(job.plan.id, 0) + 1
        if tried < ATTEMPTS and not final:
            delay = self._limits.delay_s * 4.0 ** (tried - 1)
            self._waiting.append((now + delay, job))
        else:
            self.failures.append(Failure(job.plan.id, reason, final))
