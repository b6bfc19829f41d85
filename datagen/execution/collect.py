"""Collecting a dataset: the plan, the folder and the crew; interrupted, it goes on where it was.

datagen collect --rounds 60 --out datasets/default
"""

import json
import signal
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict
from pathlib import Path
from types import FrameType
from typing import Any, Protocol

import trackfeatures as tf
from datagen.execution.lock import held, setting_up
from datagen.execution.process_pool import Hear, ProcessPool
from datagen.execution.progress import Collected, ProgressCallback, Tally
from datagen.execution.retry import Failure
from datagen.planning.plan import Plan, RoundPlan, Shard, program
from datagen.recorder.job import Job
from datagen.recording.errors import DatasetError
from datagen.recording.folder import (
    discard_partials,
    is_unstarted,
    prepare,
    read_states,
    round_path,
    write_if_changed,
)
from datagen.recording.manifest import rebuild
from datagen.recording.splits import SIDES, Split, split_path, write_split

EXECUTORS = ("local", "ray")


class Executor(Protocol):
    """Records rounds; see `crew.ProcessPool.run`."""

    def run(self, jobs: Iterable[Job]) -> list[Failure]: ...


def make_crew(executor: str, workers: int, hear: Hear) -> Executor:
    """Processes of this machine, or of a Ray cluster. Raises UserError for anything else."""
    if workers < 0:
        raise tf.UserError(f"{workers} workers asked for; give 1 or more, or 0 for one a core")
    if executor not in EXECUTORS:
        raise tf.UserError(f"there is no executor {executor!r}; choose {', '.join(EXECUTORS)}")
    if executor == "ray":
        from datagen.execution.ray_pool import RayCrew

        return RayCrew(workers, hear)
    return ProcessPool(workers, hear)


def collect(
    plan: Plan,
    folder: Path,
    workers: int,
    tracks_dir: Path | None = None,
    progress: ProgressCallback = lambda done_frames, done_rounds: None,
    *,
    executor: str = "local",
    shard: Shard | None = None,
) -> Collected:
    """Record what is missing of the plan, or of its part `shard`, into `folder`.

    Raises DatasetError when the folder holds something else or rounds failed; UserError and
    OSError as they come. Finished rounds stay in every case, unfinished ones leave no trace.
    """
    started = time.perf_counter()
    mine = plan.rounds if shard is None else shard.select(plan.rounds)
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


# Opening a dataset folder for a plan: new, empty, or the beginning of this very plan.


PLAN = "plan.json"


def require_fitting(folder: Path, plan: Plan) -> None:
    """The folder is new, empty, or holds the beginning of this very plan."""
    if not folder.exists():
        return
    if not folder.is_dir():
        raise DatasetError(f"{folder} is a file; choose a folder with --out")
    path = folder / PLAN
    if not path.is_file():
        if not is_unstarted(folder, PLAN):
            raise DatasetError(
                f"{folder} exists and is not a dataset of `datagen collect` (it has no {PLAN}); "
                "nothing was changed; choose another folder with --out"
            )
        return
    try:
        found = json.loads(path.read_text())
        found_hash, definitions, wanted = found["hash"], found["definitions"], found["wanted"]
        maker = found["program"]
    except (ValueError, KeyError, TypeError) as error:
        raise DatasetError(
            f"{path} cannot be read ({error!r}); choose another folder with --out"
        ) from error
    tf.require_version(str(definitions), str(folder))
    if maker != program():
        raise DatasetError(
            f"{folder} was made by {maker}, this is {program()}; finish it with that "
            "version, or choose another folder with --out"
        )
    if found_hash != plan.hash:
        raise DatasetError(
            f"{folder} was begun with another plan ({_differences(wanted, plan)}); give the same "
            "options to finish it, or choose another folder with --out"
        )

    if foreign := foreign_files(folder, plan):
        raise DatasetError(
            f"{foreign[0]} is no round of this plan; move it out of the dataset, or choose another "
            "folder with --out"
        )


def foreign_files(folder: Path, plan: Plan) -> list[Path]:
    """What lies among the rounds and is not of them: it would be read as one."""
    names = {f"{entry.id}.mcap" for entry in plan.rounds}
    return [path for path in sorted(folder.glob("rounds/*.mcap")) if path.name not in names]


def _differences(found: dict[str, Any], plan: Plan) -> str:
    wanted = json.loads(json.dumps(asdict(plan.config)))
    named = [
        f"{name}: {_short(found.get(name))} there, {_short(value)} asked for"
        for name, value in wanted.items()
        if found.get(name) != value
    ]
    return "; ".join(named) or "dealt otherwise"


def _short(value: Any) -> str:
    if isinstance(value, list):
        return ",".join(str(v["name"] if isinstance(v, dict) else v) for v in value)
    return str(value)


def open_folder(folder: Path, plan: Plan) -> None:
    """Write what the rounds are to be found with, whatever happens to them."""
    # First of all: by its plan the same command knows the folder again, whatever fails next.
    write_if_changed(folder / PLAN, json.dumps(plan.as_json(), indent=1) + "\n")
    prepare(folder)
    write_split(split_path(folder), split_of(plan, {entry.id for entry in plan.rounds}))


def split_of(plan: Plan, finished: set[str]) -> Split:
    """The plan's split, of the rounds that are there."""
    return Split(
        **{
            side: tuple(e.id for e in plan.rounds if e.split == side and e.id in finished)
            for side in SIDES
        }
    )
