"""Merges dataset folders: shards of one plan, or plans that share no round id and no seed."""

import errno
import hashlib
import json
import shutil
from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import Any

import trackfeatures as tf
from datagen.execution.collect import PLAN_FILE
from datagen.execution.lock import folder_lock
from datagen.planning.plan import changed_track, check_entry
from datagen.recording.errors import DatasetError
from datagen.recording.folder import (
    RoundState,
    begin_merge,
    discard_partial,
    discard_partials,
    end_merge,
    is_unstarted,
    merging_rounds,
    partial_path,
    prepare,
    publish,
    read_states,
    round_path,
    write_if_changed,
)
from datagen.recording.manifest import current_split, rebuild
from datagen.recording.mcap.index import open_round
from runtime.files import file_hash
from trackfeatures.camera import CameraParameters


@dataclass(frozen=True, slots=True)
class MergeResult:
    """Result of a merge into `out`: the plan has `planned` rounds, `rounds` of which are in `out`
    now; this merge copied `added` rounds. `frames` counts all frames in `out`."""

    rounds: int
    planned: int
    added: int
    frames: int
    content_hash: str
    out: str


def merge(folders: Sequence[Path], out: Path) -> MergeResult:
    """Copy the finished rounds of `folders` into `out`.

    Of several files of a round, an undamaged one is used, otherwise the recovered one with the most
    frames. A round in `out` is only replaced by a better file of the same round.

    Raises DatasetError for a folder without a plan, for plans that share rounds, and for a damaged
    round.
    """
    plan = _merge_plans([_read_plan(folder) for folder in folders], folders)
    if (out / PLAN_FILE).is_file():
        begun = _read_plan(out)
        if begun["hash"] != plan["hash"]:
            raise DatasetError(f"{out} was begun with other folders; choose another --out")
        _require_same_tracks([begun, plan], [out, folders[0]])
    elif out.exists() and not (out.is_dir() and is_unstarted(out, PLAN_FILE)):
        raise DatasetError(f"{out} exists and is not a dataset; choose another --out")
    out.mkdir(parents=True, exist_ok=True)
    with folder_lock(out, None):
        write_if_changed(out / PLAN_FILE, json.dumps(plan, indent=1) + "\n")
        prepare(out)
        planned = {entry["id"]: entry["split"] for entry in plan["rounds"]}
        current_split(out, planned, ())  # an unreadable split is refused before any change
        best = _best_rounds([out, *folders])
        added = sorted(i for i, (folder, _) in best.items() if folder != out and i in planned)
        try:
            _copy_rounds(best, added, out)
        except BaseException:
            with suppress(OSError, tf.UserError):  # the first error is reported, not a later one
                discard_partials(out, planned)
                _derive(out, planned)
            raise
        discard_partials(out, planned)
        states, statistics = _derive(out, planned)
    return MergeResult(
        rounds=len(states),
        planned=len(planned),
        added=len(added),
        frames=sum(state.frames for state in states.values()),
        content_hash=str(statistics["content_hash"]),
        out=str(out),
    )


def _best_rounds(folders: Sequence[Path]) -> dict[str, tuple[Path, RoundState]]:
    """Return the folder and the state of the best file of each finished round, by id. A round that
    was not recovered comes first, then the round with the most frames, then the first folder."""
    found: dict[str, list[tuple[Path, RoundState]]] = {}
    for folder in folders:
        for state in read_states(folder).values():
            found.setdefault(state.id, []).append((folder, state))
    return {
        round_id: files[0]
        if len({state.sha256 for _, state in files}) == 1
        else max(files, key=lambda file: (_is_undamaged(*file), file[1].frames))
        for round_id, files in found.items()
    }


def _is_undamaged(folder: Path, state: RoundState) -> bool:
    return open_round(folder / state.file, ()).recovery is None


def _copy_rounds(
    found: Mapping[str, tuple[Path, RoundState]], round_ids: Sequence[str], out: Path
) -> None:
    """Copy the rounds with the ids `round_ids` into `out`. `found` contains the folder and the
    state of each round by id. Readers refuse the dataset until its split lists the copied
    rounds."""
    states = read_states(out)
    if round_ids:
        # A split may leave a round out because it was recovered. An undamaged copy is a new round.
        new = (
            i
            for i in round_ids
            if i not in states or (_is_undamaged(*found[i]) and not _is_undamaged(out, states[i]))
        )
        begin_merge(out, list(new))
    for round_id in round_ids:
        _copy_round(*found[round_id], out)


def _derive(out: Path, planned: Mapping[str, str]) -> tuple[dict[str, RoundState], dict[str, Any]]:
    """Write split, statistics, card and manifest of the finished rounds in `out`. `planned`
    contains the side of the split of each planned round by id. Return the states of the finished
    rounds by id, and the statistics."""
    states = {i: state for i, state in read_states(out).items() if i in planned}
    if not states:
        end_merge(out)
        raise DatasetError("no folder has a finished round of the plan; record a shard first")
    return states, rebuild(out, current_split(out, planned, states, merging_rounds(out)))


def _read_plan(folder: Path) -> dict[str, Any]:
    path = folder / PLAN_FILE
    try:
        plan: dict[str, Any] = json.loads(path.read_text())
        tf.require_version(str(plan["definitions"]), str(folder))
        _ = plan["hash"], [(check_entry(entry), entry["split"]) for entry in plan["rounds"]]
    except FileNotFoundError as error:
        raise DatasetError(
            f"{folder} is no folder of `datagen collect` (no {PLAN_FILE})"
        ) from error
    except (ValueError, KeyError, TypeError) as error:
        raise DatasetError(f"{path} is not a plan of this version ({error!r})") from error
    return plan


def _merge_plans(plans: Sequence[dict[str, Any]], folders: Sequence[Path]) -> dict[str, Any]:
    """Return the common plan of `plans` if they are equal, otherwise a plan of all their rounds.
    `folders` are the folders of the plans, for error messages.

    Raises DatasetError if different plans have different cameras or share a round id or a seed.
    With a shared seed, the same road in the same scenery could be in training and in test.
    """
    _require_same_tracks(plans, folders)
    parts = {plan["hash"]: plan for plan in plans}
    if len(parts) == 1:
        return plans[0]
    parts = dict(sorted(parts.items()))
    entries = [entry for plan in parts.values() for entry in plan["rounds"]]
    for name, option in (("id", "--prefix"), ("seed", "--seed")):
        value, times = Counter(entry[name] for entry in entries).most_common(1)[0]
        if times > 1:
            of = zip(plans, folders, strict=False)
            holders = {
                plan["hash"]: str(folder)
                for plan, folder in of
                if any(entry[name] == value for entry in plan["rounds"])
            }
            raise DatasetError(
                f"{' and '.join(holders.values())} have different plans, each with a round of the "
                f"{name} {value}; merge shards that were started with the same options, or collect "
                f"one of the datasets with another {option}"
            )
    _require_one_camera(plans, folders)
    drivers = {tuple(plan["driver"].values()) for plan in parts.values() if "driver" in plan}
    joined = {"driver": {"drivers": "; ".join(", ".join(d) for d in sorted(drivers))}}
    return {
        "hash": hashlib.sha256("".join(parts).encode()).hexdigest(),
        "definitions": tf.VERSION,
        "program": "; ".join(sorted({plan["program"] for plan in parts.values()})),
        "wanted": {name: plan["wanted"] for name, plan in parts.items()},
        **(joined if drivers else {}),
        "rounds": entries,
    }


def _require_same_tracks(plans: Sequence[dict[str, Any]], folders: Sequence[Path]) -> None:
    """Raise DatasetError if two folders of one plan were recorded with another surface, scenery or
    paint of a track."""
    for (plan, folder), (other, another) in combinations(zip(plans, folders, strict=True), 2):
        if plan["hash"] != other["hash"]:
            continue
        if track := changed_track(plan["rounds"], other["rounds"]):
            raise DatasetError(
                f"{folder} and {another} were recorded with another surface, scenery or paint of "
                f"the track {track}; record one of them again with the track of the other"
            )


def _require_one_camera(plans: Sequence[dict[str, Any]], folders: Sequence[Path]) -> None:
    """Raise DatasetError if the rounds of two folders were planned with different cameras."""
    holders: dict[CameraParameters, Path] = {}
    for plan, folder in zip(plans, folders, strict=True):
        for entry in plan["rounds"]:
            holders.setdefault(CameraParameters(**entry["nominal_camera"]), folder)
    if len(holders) > 1:
        (one, folder), (other, another) = list(holders.items())[:2]
        raise DatasetError(
            f"{folder} and {another} have different cameras, {one} and {other}; keep them apart"
        )


def _copy_round(folder: Path, state: RoundState, out: Path) -> None:
    partial = partial_path(out, state.id)
    try:
        try:
            shutil.copyfile(folder / state.file, partial)
        except OSError as error:
            if error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG):
                error.filename = str(partial)  # shutil names the source first
            raise
        if file_hash(partial) != state.sha256:
            raise DatasetError(
                f"{folder / state.file} is damaged (its SHA-256 differs from the recorded one); "
                "delete it and record that shard again"
            )
        publish(out, partial, state)
    except BaseException:
        if not partial.exists() and state.id not in read_states(out):
            round_path(out, state.id).unlink(missing_ok=True)  # moved here, but without a state
        raise
    finally:
        discard_partial(out, state.id)
