"""Collecting a dataset: the plan, the folder and the crew; interrupted, it goes on where it was.

datagen collect --rounds 60 --out datasets/default
"""

import fcntl
import json
import os
import signal
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from types import FrameType
from typing import Any, Protocol

import trackfeatures as tf
from datagen.crew import Crew, Failure
from datagen.plan import Plan
from datagen.recording.derived import rebuild
from datagen.recording.errors import DatasetError
from datagen.recording.folder import (
    barely_begun,
    discard_partials,
    prepare,
    read_states,
    round_path,
    write_synced,
)
from datagen.recording.splits import Split, split_path, write_split
from datagen.worker import FramesDone, Job, RoundDone

PLAN = "plan.json"


class Progress(Protocol):
    """Hears how the collection goes."""

    def __call__(self, done_frames: int, done_rounds: int) -> None: ...


@dataclass(frozen=True, slots=True)
class Collected:
    """`rounds` and `frames` are in the folder; `recorded_frames` of them came in this run."""

    rounds: int
    frames: int
    seconds: float
    frames_per_second: float
    recorded_frames: int
    resets: int
    out: str

    def as_json(self) -> dict[str, Any]:
        return asdict(self)


def collect(
    plan: Plan,
    folder: Path,
    workers: int,
    tracks_dir: Path | None = None,
    progress: Progress = lambda done_frames, done_rounds: None,
) -> Collected:
    """Record what is missing of the plan into `folder`.

    Raises DatasetError when the folder holds something else or rounds failed; UserError and
    OSError as they come. Finished rounds stay in every case, unfinished ones leave no trace.
    """
    if workers < 1:
        raise tf.UserError(f"{workers} workers asked for; at least one is needed")
    started = time.perf_counter()
    _require_fitting(folder, plan)
    folder.mkdir(parents=True, exist_ok=True)
    with _alone(folder):
        _open_folder(folder, plan)
        tally = _Tally(plan, read_states(folder).keys(), progress)
        missing = [entry for entry in plan.rounds if entry.id not in tally.finished]
        crew = Crew(workers, tally.hear)
        with _terminable():
            try:
                failures = crew.run(Job(e, plan.hash, folder, tracks_dir) for e in missing)
            finally:
                _sweep(folder, plan)
        if tally.finished:
            rebuild(folder, _split(plan, set(tally.finished)))
    if failures:
        raise DatasetError(_told(failures, len(plan.rounds)))
    return tally.result(folder, time.perf_counter() - started)


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


class _Tally:
    """Counts what the crew reports."""

    def __init__(self, plan: Plan, finished: Any, progress: Progress) -> None:
        self._frames_of = {entry.id: entry.frames for entry in plan.rounds}
        self.finished = [round_id for round_id in self._frames_of if round_id in finished]
        self._before = sum(self._frames_of[round_id] for round_id in self.finished)
        self._running: dict[str, int] = {}
        self._resets = 0
        self._progress = progress
        progress(self._before, len(self.finished))

    def hear(self, message: FramesDone | RoundDone) -> None:
        if isinstance(message, FramesDone):
            self._running[message.round_id] = message.frames
        else:
            self._running.pop(message.state.id, None)
            self.finished.append(message.state.id)
            self._resets += message.resets
        self._progress(self._done() + sum(self._running.values()), len(self.finished))

    def result(self, folder: Path, seconds: float) -> Collected:
        recorded = self._done() - self._before
        return Collected(
            rounds=len(self.finished),
            frames=self._done(),
            seconds=round(seconds, 3),
            frames_per_second=round(recorded / seconds, 2),
            recorded_frames=recorded,
            resets=self._resets,
            out=str(folder),
        )

    def _done(self) -> int:
        return sum(self._frames_of[round_id] for round_id in self.finished)


def _require_fitting(folder: Path, plan: Plan) -> None:
    """The folder is new, empty, or holds the beginning of this very plan."""
    if not folder.exists():
        return
    if not folder.is_dir():
        raise DatasetError(f"{folder} is a file; choose a folder with --out")
    path = folder / PLAN
    if not path.is_file():
        if not barely_begun(folder, PLAN):
            raise DatasetError(
                f"{folder} exists and is not a dataset of `datagen collect` (it has no {PLAN}); "
                "nothing was changed; choose another folder with --out"
            )
        return
    try:
        found = json.loads(path.read_text())
        found_hash, definitions, wanted = found["hash"], found["definitions"], found["wanted"]
    except (ValueError, KeyError, TypeError) as error:
        raise DatasetError(
            f"{path} cannot be read ({error!r}); choose another folder with --out"
        ) from error
    tf.require_version(str(definitions), str(folder))
    if found_hash != plan.hash:
        raise DatasetError(
            f"{folder} was begun with another plan ({_differences(wanted, plan)}); give the same "
            "options to finish it, or choose another folder with --out"
        )


def _differences(found: dict[str, Any], plan: Plan) -> str:
    wanted = json.loads(json.dumps(asdict(plan.wanted)))
    named = [
        f"{name}: {_short(found.get(name))} there, {_short(value)} asked for"
        for name, value in wanted.items()
        if found.get(name) != value
    ]
    return "; ".join(named) or "made by another version of this program"


def _short(value: Any) -> str:
    if isinstance(value, list):
        return ",".join(str(v["name"] if isinstance(v, dict) else v) for v in value)
    return str(value)


def _open_folder(folder: Path, plan: Plan) -> None:
    discard_partials(folder)
    # First of all: by its plan the same command knows the folder again, whatever fails next.
    write_synced(folder / PLAN, json.dumps(plan.as_json(), indent=1) + "\n")
    prepare(folder)
    # Whatever happens from here on, the rounds that are finished can be read.
    write_split(split_path(folder), _split(plan, {entry.id for entry in plan.rounds}))


def _split(plan: Plan, finished: set[str]) -> Split:
    sides = {
        side: tuple(e.id for e in plan.rounds if e.split == side and e.id in finished)
        for side in ("train", "test")
    }
    return Split(train=sides["train"], test=sides["test"])


def _sweep(folder: Path, plan: Plan) -> None:
    """Take away what an interrupted round left."""
    discard_partials(folder)
    states = read_states(folder)
    for entry in plan.rounds:
        if entry.id not in states:
            round_path(folder, entry.id).unlink(missing_ok=True)


@contextmanager
def _alone(folder: Path) -> Iterator[None]:
    """Hold the folder against a second collection."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        os.close(descriptor)
        raise DatasetError(
            f"another `datagen collect` is writing to {folder}; wait for it or choose another --out"
        ) from error
    try:
        yield
    finally:
        os.close(descriptor)


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
