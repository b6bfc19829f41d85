"""Collecting a dataset: the plan, the folder and the crew; interrupted, it goes on where it was.

datagen collect --rounds 60 --out datasets/default
"""

import signal
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from types import FrameType
from typing import Any, Protocol

import trackfeatures as tf
from datagen.crew import Crew, Hear
from datagen.lock import held, setting_up
from datagen.opening import open_folder, require_fitting, split_of
from datagen.plan import Plan, RoundPlan
from datagen.recording.derived import rebuild
from datagen.recording.errors import DatasetError
from datagen.recording.folder import discard_partials, read_states, round_path
from datagen.round import Job
from datagen.shard import Shard
from datagen.tally import Collected, Progress, Tally
from datagen.tries import Failure

EXECUTORS = ("local", "ray")


class Executor(Protocol):
    """Records rounds; see `crew.Crew.run`."""

    def run(self, jobs: Iterable[Job]) -> list[Failure]: ...


def make_crew(executor: str, workers: int, hear: Hear) -> Executor:
    """Processes of this machine, or of a Ray cluster. Raises UserError for anything else."""
    if workers < 0:
        raise tf.UserError(f"{workers} workers asked for; give 1 or more, or 0 for one a core")
    if executor not in EXECUTORS:
        raise tf.UserError(f"there is no executor {executor!r}; choose {', '.join(EXECUTORS)}")
    if executor == "ray":
        from datagen.ray_crew import RayCrew

        return RayCrew(workers, hear)
    return Crew(workers, hear)


def collect(
    plan: Plan,
    folder: Path,
    workers: int,
    tracks_dir: Path | None = None,
    progress: Progress = lambda done_frames, done_rounds: None,
    *,
    executor: str = "local",
    shard: Shard | None = None,
) -> Collected:
    """Record what is missing of the plan, or of its part `shard`, into `folder`.

    Raises DatasetError when the folder holds something else or rounds failed; UserError and
    OSError as they come. Finished rounds stay in every case, unfinished ones leave no trace.
    """
    started = time.perf_counter()
    mine = plan.rounds if shard is None else shard.of(plan.rounds)
    make_crew(executor, workers, lambda message: None)  # what cannot be is refused first
    require_fitting(folder, plan)
    folder.mkdir(parents=True, exist_ok=True)
    with _terminable(), held(folder, shard):
        with setting_up(folder):
            open_folder(folder, plan)
        _sweep(folder, mine)
        tally = Tally(mine, read_states(folder).keys(), progress)
        missing = [entry for entry in mine if entry.id not in tally.finished]
        crew = make_crew(executor, workers, tally.hear)
        try:
            failures = crew.run(Job(e, plan.hash, folder, tracks_dir) for e in missing)
        except BaseException:
            with suppress(OSError, tf.UserError):  # what went wrong first is what is told
                _sweep(folder, mine)
                _derive(folder, plan, shard)
            raise
        _sweep(folder, mine)
        content_hash = _derive(folder, plan, shard)
    if failures:
        raise DatasetError(_told(failures, len(mine)))
    return tally.result(folder, time.perf_counter() - started, content_hash)


def _derive(folder: Path, plan: Plan, shard: Shard | None) -> str | None:
    """Manifest, split, statistics and card of what is there; the dataset's hash.

    The last shard of a folder to end finds all rounds there; the others leave it to that one.
    """
    with setting_up(folder):
        finished = read_states(folder).keys() & {entry.id for entry in plan.rounds}
        if not finished or (shard is not None and len(finished) < len(plan.rounds)):
            return None
        return str(rebuild(folder, split_of(plan, set(finished)))["content_hash"])


def _told(failures: Sequence[Failure], planned: int) -> str:
    names = ", ".join(failure.round_id for failure in failures)
    if all(failure.final for failure in failures):
        advice = "other --tracks or another --seed, with another --out, may avoid this"
    else:
        advice = "run the same command again to try what failed once more"
    return (
        f"{len(failures)} of {planned} rounds failed ({names}: {failures[0].reason}); "
        f"what was finished can be used; {advice}"
    )


def _sweep(folder: Path, rounds: Sequence[RoundPlan]) -> None:
    """Take away what interruptions left of these rounds."""
    discard_partials(folder, (entry.id for entry in rounds))
    states = read_states(folder)
    for entry in rounds:
        if entry.id not in states:
            round_path(folder, entry.id).unlink(missing_ok=True)


@contextmanager
def _terminable() -> Iterator[None]:
    """SIGTERM ends a collection as Ctrl-C does."""

    def interrupt(number: int, frame: FrameType | None) -> None:
        raise KeyboardInterrupt

    before: Callable[..., Any] | int | None = signal.signal(signal.SIGTERM, interrupt)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)
