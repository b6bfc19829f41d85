"""Makes and checks the split of a dataset; counts near-duplicate frames across its sides."""

import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from datagen.recording.dataset import Dataset, open_rounds
from datagen.recording.errors import DatasetError
from datagen.recording.names import SIDES, UNSEEN
from datagen.recording.near_duplicates import NearDuplicates, Tolerances, find_near_duplicates
from datagen.recording.round_metadata import RoundInfo
from datagen.recording.splits import (
    RoundKey,
    read_split,
    require_disjoint,
    split_path,
    split_rounds,
    write_split,
)

TRAIN = SIDES[0]
PAIRS_SHOWN = 3


@dataclass(frozen=True, slots=True)
class SplitConfig:
    """Options of `datagen split`; the command declares their defaults."""

    by: str
    test_share: float
    seed: int
    with_recovered: bool


@dataclass(frozen=True, slots=True)
class SplitReport:
    """A valid split: numbers of rounds and frames by side and, for each side except train, the
    numbers of frames with a near-duplicate in train. `made` is true if this command created the
    split."""

    path: Path
    made: bool
    rounds: dict[str, int]
    frames: dict[str, int]
    near: dict[str, NearDuplicates]

    def as_json(self) -> dict[str, Any]:
        return {
            "path": str(self.path),
            "made": self.made,
            "rounds": self.rounds,
            "frames": self.frames,
            "near_duplicates": {side: found.as_json() for side, found in self.near.items()},
        }


def make_split(folder: Path, name: str, config: SplitConfig) -> Path:
    """Write a new split and return its path. Rounds that are unseen in the default split (if it is
    missing: in the plan) stay unseen.

    Raises DatasetError if the name exists, there are too few rounds, the split would leak, or the
    default split or the plan cannot be read.
    """
    path = split_path(folder, name)
    if path.exists():
        raise DatasetError(f"{path} exists and stays as it is; choose another --name")
    indexes = open_rounds(folder)
    usable = [ix for ix in indexes if config.with_recovered or ix.recovery is None]
    unseen = _unseen(folder)
    infos = [
        RoundInfo.of(ix.path, ix.header, ix.result, "")
        for ix in usable
        if ix.header.id not in unseen
    ]
    split = replace(
        split_rounds(infos, config.by, config.test_share, config.seed),
        unseen=tuple(ix.header.id for ix in usable if ix.header.id in unseen),
        recovered=tuple(ix.header.id for ix in usable if ix.recovery is not None),
    )
    require_disjoint(
        split, [RoundKey(ix.header.id, ix.header.seed, ix.result.content_hash) for ix in usable]
    )
    path.parent.mkdir(exist_ok=True)
    write_split(path, split)
    return path


def _unseen(folder: Path) -> set[str]:
    """Return the ids of the rounds that are unseen in the default split or, if it is missing, in
    the plan. A dataset without both has none."""
    default, plan = split_path(folder), folder / "plan.json"
    if default.exists():
        return set(read_split(default).unseen)
    if not plan.is_file():
        return set()
    try:
        entries = json.loads(plan.read_text())["rounds"]
        return {entry["id"] for entry in entries if entry["split"] == UNSEEN}
    except (ValueError, KeyError, TypeError) as error:
        raise DatasetError(
            f"{plan} cannot be read ({error!r}), so the unseen rounds are not known; restore the "
            f"file, or write the split {default}"
        ) from error


def check_split(folder: Path, name: str, tolerances: Tolerances, *, made: bool) -> SplitReport:
    """Check a split and return its report. `tolerances` are the largest differences between
    near-duplicates. `made` is true if the running command has just created the split, false if
    the split existed before; it is copied to the report.
    Raises DatasetError if a round, seed or content hash is on two sides."""
    dataset = Dataset.open(folder, name)
    frames = dataset.select("all")
    sides = np.array([info.split for info in frames.rounds])
    of_frame = sides[frames.labels.round]
    here = [side for side in SIDES if (sides == side).any()]
    return SplitReport(
        path=split_path(folder, name),
        made=made,
        rounds={side: int((sides == side).sum()) for side in here},
        frames={side: int((of_frame == side).sum()) for side in here},
        near={
            side: find_near_duplicates(
                frames.labels, frames.rounds, of_frame == side, of_frame == TRAIN, tolerances
            )
            for side in here
            if side != TRAIN
        },
    )


def format_report(report: SplitReport) -> str:
    """Format the report as text: a line for each side, with its nearest pairs below."""
    lines = [
        f"{report.path}{' (made)' if report.made else ''}: no round, seed or content on two sides"
    ]
    for side, rounds in report.rounds.items():
        line = f"  {side:<6} {rounds} rounds, {report.frames[side]} frames"
        found = report.near.get(side)
        if found is None:
            lines.append(line)
            continue
        share = found.near / max(found.frames, 1)
        lines.append(f"{line}; {found.near} ({share:.1%}) near-duplicates of {TRAIN}")
        lines += [
            f"    {p.round} frame {p.frame} and {p.other_round} frame {p.other_frame}: "
            f"{p.track}, {p.s_m:.1f} m, {p.distance:.2f} of the tolerances apart"
            for p in found.worst[:PAIRS_SHOWN]
        ]
    return "\n".join(lines)
