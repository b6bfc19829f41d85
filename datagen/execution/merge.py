"""Putting together what the shards of one plan recorded into folders of their own."""

import json
import shutil
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import trackfeatures as tf
from datagen.execution.collect import PLAN
from datagen.execution.lock import held
from datagen.recording.errors import DatasetError
from datagen.recording.folder import (
    RoundState,
    discard_partial,
    discard_partials,
    file_sha256,
    partial_path,
    prepare,
    publish,
    read_states,
    write_if_changed,
)
from datagen.recording.manifest import rebuild
from datagen.recording.splits import SIDES, Split


@dataclass(frozen=True, slots=True)
class Merged:
    """`rounds` of the plan's `planned` are in the folder now, `added` of them just came."""

    rounds: int
    planned: int
    added: int
    frames: int
    content_hash: str
    out: str

    def as_json(self) -> dict[str, Any]:
        return asdict(self)


def merge(folders: Sequence[Path], out: Path) -> Merged:
    """Copy the finished rounds of `folders` into `out`; those that are there already stay.

    Raises DatasetError when a folder holds no plan or another one, or a round is damaged.
    """
    plans = [_plan_of(folder) for folder in folders]
    if (out / PLAN).is_file():
        plans.append(_plan_of(out))
    elif out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise DatasetError(f"{out} exists and is not a dataset; choose another --out")
    _require_one_plan(plans, [*folders, out])
    plan = plans[0]
    out.mkdir(parents=True, exist_ok=True)
    with held(out, None):
        write_if_changed(out / PLAN, json.dumps(plan, indent=1) + "\n")
        prepare(out)
        there = read_states(out).keys()
        found = {s.id: (folder, s) for folder in folders for s in read_states(folder).values()}
        planned = {entry["id"]: entry["split"] for entry in plan["rounds"]}
        for round_id in sorted(found.keys() & planned.keys() - there):
            _copy(*found[round_id], out)
        discard_partials(out, planned)
        states = {i: state for i, state in read_states(out).items() if i in planned}
        if not states:
            raise DatasetError("no folder holds a finished round of the plan")
        sides = {side: tuple(i for i in states if planned[i] == side) for side in SIDES}
        statistics = rebuild(out, Split(**sides))
    return Merged(
        rounds=len(states),
        planned=len(planned),
        added=len(states) - len(there & planned.keys()),
        frames=sum(state.frames for state in states.values()),
        content_hash=str(statistics["content_hash"]),
        out=str(out),
    )


def _plan_of(folder: Path) -> dict[str, Any]:
    path = folder / PLAN
    try:
        plan: dict[str, Any] = json.loads(path.read_text())
        tf.require_version(str(plan["definitions"]), str(folder))
        _ = plan["hash"], [(entry["id"], entry["split"]) for entry in plan["rounds"]]
    except FileNotFoundError as error:
        raise DatasetError(f"{folder} is no folder of `datagen collect` (no {PLAN})") from error
    except (ValueError, KeyError, TypeError) as error:
        raise DatasetError(f"{path} is no plan of this program ({error!r})") from error
    return plan


def _require_one_plan(plans: Sequence[dict[str, Any]], folders: Sequence[Path]) -> None:
    for plan, folder in zip(plans, folders, strict=False):
        if plan["hash"] != plans[0]["hash"]:
            raise DatasetError(
                f"{folder} was begun with another plan than {folders[0]}; merge shards that were "
                "started with the same options"
            )


def _copy(folder: Path, state: RoundState, out: Path) -> None:
    partial = partial_path(out, state.id)
    try:
        shutil.copyfile(folder / state.file, partial)
        if file_sha256(partial) != state.sha256:
            raise DatasetError(
                f"{folder / state.file} is damaged (its sha256 is not that of its state); delete "
                "it and record that shard again"
            )
        publish(out, partial, state)
    finally:
        discard_partial(out, state.id)
