"""Collects a dataset: records the missing rounds of a plan into a folder.

An interrupted collection is continued by the same command.

datagen collect --rounds 60 --out datasets/default
"""

import json
import time
from collections.abc import Collection, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import trackfeatures as tf
from datagen.execution.lock import folder_lock, setup_lock
from datagen.execution.process_pool import ProcessPool
from datagen.execution.progress import CollectProgress, CollectResult, ProgressCallback
from datagen.execution.retry import Failure, OnMessage
from datagen.planning.config import LATER
from datagen.planning.plan import DRIVER_FILES, Plan, RoundPlan, Shard, changed_track, program
from datagen.recorder.job import Job
from datagen.recording.errors import DatasetError
from datagen.recording.folder import (
    discard_partials,
    is_unstarted,
    prepare,
    read_states,
    require_merged,
    round_path,
    state_path,
    write_if_changed,
)
from datagen.recording.manifest import current_split, rebuild
from datagen.recording.splits import split_path, write_split

if TYPE_CHECKING:
    from datagen.recorder.record import MakeLaw

EXECUTORS = ("local", "ray")
PLAN_FILE = "plan.json"


class Executor(Protocol):
    """Interface of `ProcessPool` and `RayPool`. `run` records the rounds of `jobs` and returns the
    failed rounds."""

    def run(self, jobs: Iterable[Job]) -> list[Failure]: ...


def make_pool(executor: str, workers: int, on_message: OnMessage) -> Executor:
    """Create the executor: processes on this machine ("local") or actors on a Ray cluster ("ray").

    `workers` is the number of processes or actors; 0 means one per core. `on_message` receives the
    progress of each round. Raises UserError for an unknown executor or a negative number of
    workers.
    """
    if workers < 0:
        raise tf.UserError(f"{workers} workers asked for; give 1 or more, or 0 for all cores")
    if executor not in EXECUTORS:
        raise tf.UserError(f"there is no executor {executor!r}; choose {', '.join(EXECUTORS)}")
    if executor == "ray":
        from datagen.execution.ray_pool import RayPool

        return RayPool(workers, on_message)
    return ProcessPool(workers, on_message)


def collect(
    plan: Plan,
    folder: Path,
    workers: int,
    tracks_dir: Path | None = None,
    progress: ProgressCallback = lambda done_frames, done_rounds: None,
    *,
    executor: str = "local",
    shard: Shard | None = None,
    make_law: "MakeLaw | None" = None,
) -> CollectResult:
    """Record the missing rounds of the plan, or of its part `shard`, into `folder`. Return the
    totals.

    `workers` is the number of processes; 0 means one per core. `tracks_dir` is a further folder of
    tracks. `progress` is called with the numbers of recorded frames and rounds. `executor` is
    "local" or "ray" (see `make_pool`). `make_law` creates a steering law for each round in place of
    the scripted driver's law; `plan.driver` must then name it.

    Raises DatasetError if the folder contains anything but a dataset of this plan or a round cannot
    be recorded, and UserError or OSError if recording is impossible (full disk). Finished rounds
    always stay in `folder`; files of unfinished rounds are removed.
    """
    started = time.perf_counter()
    rounds = plan.rounds if shard is None else shard.select(plan.rounds)
    make_pool(executor, workers, lambda message: None)  # checks the options before any change
    require_matching_folder(folder, plan)
    folder.mkdir(parents=True, exist_ok=True)
    with folder_lock(folder, shard):
        with setup_lock(folder):
            unrecorded = _unrecorded(folder, plan)
            initialise_folder(folder, plan)
        _remove_leftovers(folder, rounds)
        counter = CollectProgress(rounds, read_states(folder), progress)
        missing = [entry for entry in rounds if entry.id not in counter.finished]
        pool = make_pool(executor, workers, counter.on_message)
        try:
            failures = pool.run(Job(e, plan.hash, folder, tracks_dir, make_law) for e in missing)
        except BaseException:
            with suppress(OSError, tf.UserError):  # the first error is reported, not a later one
                _remove_leftovers(folder, rounds)
                _write_derived_files(folder, plan, shard, unrecorded)
            raise
        _remove_leftovers(folder, rounds)
        content_hash = _write_derived_files(folder, plan, shard, unrecorded)
    if failures:
        raise DatasetError(_failure_message(failures, len(rounds)))
    return counter.result(folder, time.perf_counter() - started, content_hash)


def _write_derived_files(
    folder: Path, plan: Plan, shard: Shard | None, unrecorded: Collection[str]
) -> str | None:
    """Write manifest, split, statistics and card of the finished rounds; return the dataset's hash.
    `unrecorded` are the ids of the rounds that had never been recorded before this collection.

    If `shard` is given and rounds of the plan are still missing, nothing is written and the result
    is None: the shard that ends last writes the files.
    """
    with setup_lock(folder):
        finished = read_states(folder).keys() & {entry.id for entry in plan.rounds}
        if not finished or (shard is not None and len(finished) < len(plan.rounds)):
            return None
        split = current_split(folder, sides_of(plan), finished, unrecorded)
        return str(rebuild(folder, split)["content_hash"])


def _failure_message(failures: Sequence[Failure], planned: int) -> str:
    names = ", ".join(failure.round_id for failure in failures)
    if all(failure.final for failure in failures):
        advice = "other tracks or another --seed, with another --out, may avoid this"
    else:
        advice = "run the same command again for another attempt"
    return (
        f"{len(failures)} of {planned} rounds failed ({names}: {failures[0].reason}); "
        f"the finished rounds can be used; {advice}"
    )


def _remove_leftovers(folder: Path, rounds: Sequence[RoundPlan]) -> None:
    """Delete the files of these rounds that interrupted collections have left unfinished."""
    discard_partials(folder, (entry.id for entry in rounds))
    states = read_states(folder)
    for entry in rounds:
        if entry.id not in states:
            round_path(folder, entry.id).unlink(missing_ok=True)


def require_matching_folder(folder: Path, plan: Plan) -> None:
    """Raise DatasetError unless `folder` is missing, empty, or a dataset of `plan` into which no
    merge has been interrupted.

    Raises DefinitionsMismatch for a dataset recorded with another version of the label definitions.
    """
    if not folder.exists():
        return
    if not folder.is_dir():
        raise DatasetError(f"{folder} is a file; choose a folder with --out")
    path = folder / PLAN_FILE
    if not path.is_file():
        if not is_unstarted(folder, PLAN_FILE):
            raise DatasetError(
                f"{folder} exists and is not a dataset of `datagen collect` (no {PLAN_FILE}). "
                "Nothing was changed; choose another folder with --out"
            )
        return
    require_merged(folder)
    try:
        found = json.loads(path.read_text())
        found_hash, definitions, options = found["hash"], found["definitions"], found["wanted"]
        maker, driver = found["program"], found.get("driver", {})
        changed = changed_track(found["rounds"], [entry.as_dict() for entry in plan.rounds])
        reshaped = _changed_geometry(found["rounds"], plan)
        other = _other_round(found["rounds"], plan) if found_hash != plan.hash else ""
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
    if driver and DRIVER_FILES not in driver:  # a plan of an earlier version
        plan = replace(plan, driver={k: v for k, v in plan.driver.items() if k != DRIVER_FILES})
    if reshaped is not None:
        raise DatasetError(
            f"{folder} was begun with another geometry of the track {reshaped}; restore the "
            "track to finish it, or choose another folder with --out"
        )
    if found_hash != plan.hash:
        differences = _differences(options, driver, plan) or other
        raise DatasetError(
            f"{folder} was begun with another plan ({differences}); give the "
            "same options to finish it, or choose another folder with --out"
        )
    if changed is not None:
        raise DatasetError(
            f"{folder} was begun with another surface, scenery or paint of the track {changed}; "
            "restore the track to finish it, or choose another folder with --out"
        )
    if foreign := foreign_files(folder, plan):
        raise DatasetError(
            f"{foreign[0]} is no round of this plan; move it out of the dataset, or choose another "
            "folder with --out"
        )


def foreign_files(folder: Path, plan: Plan) -> list[Path]:
    """Return the files in rounds/ that do not belong to the plan; readers would read them as
    rounds."""
    names = {f"{entry.id}.mcap" for entry in plan.rounds}
    return [path for path in sorted(folder.glob("rounds/*.mcap")) if path.name not in names]


def _changed_geometry(entries: Sequence[dict[str, Any]], plan: Plan) -> str | None:
    """Return the name of a track whose geometry differs between `entries`, the rounds of the plan
    in the folder, and `plan`; None if there is none or the rounds are on other tracks."""
    known = {entry["id"]: (entry["track"], entry["track_hash"]) for entry in entries}
    if {i: track for i, (track, _) in known.items()} != {e.id: e.track for e in plan.rounds}:
        return None
    return next((e.track for e in plan.rounds if e.track_hash != known[e.id][1]), None)


def _differences(found: dict[str, Any], driver: Mapping[str, str], plan: Plan) -> str:
    """List the options and the driver that differ between the plan in the folder and `plan`.
    `found` are the options and `driver` is the driver of the plan in the folder."""
    found = LATER | found
    wanted = json.loads(json.dumps(LATER | plan.config.as_dict()))
    named = [
        f"{name}: {_short(found.get(name))} in its plan, now {_short(value)}"
        for name, value in wanted.items()
        if found.get(name) != value
    ]
    if plan.driver != driver:
        named.append(f"driver: {_named(driver)} in its plan, now {_named(plan.driver)}")
    return "; ".join(named)


def _other_round(entries: Sequence[dict[str, Any]], plan: Plan) -> str:
    """Describe the first difference between `entries`, the rounds of the plan in the folder, and
    the rounds of `plan`. The option --laps of `datagen protocol` is only in the rounds."""
    if len(entries) != len(plan.rounds):
        return f"{len(entries)} rounds in its plan, now {len(plan.rounds)}"
    wanted = json.loads(json.dumps([entry.as_dict() for entry in plan.rounds]))
    for found, entry in zip(entries, wanted, strict=True):
        for name, value in entry.items():
            if name != "picture_hash" and found.get(name) != value:
                was = _short(found.get(name))
                return f"{name} of {entry['id']}: {was} in its plan, now {_short(value)}"
    return "the same options, other rounds"


def _named(driver: Mapping[str, str]) -> str:
    return ", ".join(f"{name} {value}" for name, value in driver.items()) or "the scripted one"


def _short(value: Any) -> str:
    if isinstance(value, list):
        return ",".join(str(v["name"] if isinstance(v, dict) else v) for v in value)
    return str(value)


def initialise_folder(folder: Path, plan: Plan) -> None:
    """Write the plan and the split into `folder` and create its subfolders."""
    # The plan is written first, because the same command needs it to continue after a failure.
    write_if_changed(folder / PLAN_FILE, json.dumps(plan.as_json(), indent=1) + "\n")
    prepare(folder)
    sides = sides_of(plan)
    split = current_split(folder, sides, sides, _unrecorded(folder, plan))
    write_split(split_path(folder), split)


def _unrecorded(folder: Path, plan: Plan) -> set[str]:
    """Return the ids of the planned rounds that have never been recorded. A recorded round whose
    file is missing has a state, and is not among them."""
    return {entry.id for entry in plan.rounds if not state_path(folder, entry.id).exists()}


def sides_of(plan: Plan) -> dict[str, str]:
    """Return the side of the split of each planned round by id."""
    return {entry.id: entry.split for entry in plan.rounds}
