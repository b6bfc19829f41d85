"""Writes the derived files of a dataset folder: manifest, split, statistics and dataset card.

`manifest.json` lists the rounds with their metadata and hashes, and the hashes of other files.
Verification computes the manifest again from the rounds, and so finds damage in it.
"""

import json
from collections.abc import Collection, Iterator, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import trackfeatures as tf
from datagen.recording.card import render_card
from datagen.recording.dataset import Dataset
from datagen.recording.errors import MAKE_AGAIN
from datagen.recording.folder import (
    PUBLISHED_FILES,
    end_merge,
    read_states,
    state_path,
    write_if_changed,
)
from datagen.recording.mcap.index import open_round
from datagen.recording.names import SIDES
from datagen.recording.splits import Split, read_split, split_path, write_split
from datagen.recording.statistics import describe
from runtime.files import file_hash
from trackfeatures.camera import stored

MANIFEST = "manifest.json"
# The dataset card is not hashed, because people edit it.
HASHED_FILES = (*PUBLISHED_FILES, "plan.json", "stats.json")


def build_manifest(dataset: Dataset) -> dict[str, Any]:
    """Compute the content of `manifest.json` from the rounds, their states and the other files."""
    states = read_states(dataset.path)
    rounds = []
    for info, index in zip(dataset.rounds, dataset.indexes, strict=True):
        header = asdict(index.header, dict_factory=stored)
        del header["varied"]  # some kB for each scene; the plan and the round's file hold it
        state = states.get(info.id)
        rounds.append(
            {
                **header,
                **asdict(index.result),
                "split": info.split,
                "file": f"rounds/{info.path.name}",
                "bytes": info.path.stat().st_size,
                "sha256": state.sha256 if state else None,
            }
        )
    paths = {name: dataset.path / name for name in HASHED_FILES}
    return {
        "definitions": tf.VERSION,
        "content_hash": dataset.content_hash,
        "frames": sum(info.frames for info in dataset.rounds),
        "files": {name: file_hash(path) for name, path in paths.items() if path.is_file()},
        "rounds": rounds,
    }


def to_json(content: dict[str, Any]) -> str:
    return json.dumps(content, indent=1) + "\n"


def manifest_problems(folder: Path) -> Iterator[str]:
    """Yield the problems of `manifest.json`, one line each. Raises the errors of `Dataset.open`."""
    path = folder / MANIFEST
    remedy = f"{MAKE_AGAIN} to write it anew"
    if not path.is_file():
        yield f"there is no {path}; {remedy}"
        return
    expected = build_manifest(Dataset.open(folder))
    data = path.read_bytes()
    if data == to_json(expected).encode():
        return
    try:
        found = json.loads(data)
        stated, actual = found["files"], expected["files"]
        names = {**actual, **stated}
        changed = [name for name in names if stated.get(name) != actual.get(name)]
    except (ValueError, KeyError, TypeError, AttributeError):
        changed = []
    if changed:
        yield f"{', '.join(sorted(changed))} in {folder}: other content than {MANIFEST} was made of"
    else:
        yield f"{path} does not describe the rounds in the folder; {remedy}"


def current_split(
    folder: Path,
    side_of: Mapping[str, str],
    listed: Collection[str],
    added: Collection[str] = (),
) -> Split:
    """Return the split of a plan, with only the rounds whose ids are in `listed`; or, if the user
    has replaced it (for example by a split of `datagen split --by track --name NAME`), the split in
    `folder`, with only these rounds and the recorded rounds whose file is missing now.

    `side_of` contains the side of each planned round by id. `added` are the ids of rounds that are
    new in `folder`; those that its split does not name are on their planned side. All other rounds
    that its split does not name stay on no side. Raises DatasetError if the split in `folder` or a
    round is damaged.
    """
    planned = _planned_split(folder, side_of, listed)
    path = split_path(folder)
    if not path.is_file():
        return planned
    found = read_split(path)
    named = {i for side in SIDES for i in getattr(found, side)}
    new = {*added} - named
    # A round whose file was deleted is recorded again: until then the user's split keeps its side.
    kept = {*listed, *(i for i in side_of if state_path(folder, i).exists())}
    moved = any(found.side(i) != side_of[i] for i in named & kept)
    known = read_states(folder).keys() & side_of.keys() - new
    if not moved and not known - named - {*planned.recovered}:
        return planned
    sides = {
        side: (
            *(i for i in getattr(found, side) if i in kept),
            *(i for i in getattr(planned, side) if i in new),
        )
        for side in SIDES
    }
    used = {i for ids in sides.values() for i in ids}
    return Split(**sides, recovered=tuple(i for i in planned.recovered if i in used))


def _planned_split(folder: Path, side_of: Mapping[str, str], listed: Collection[str]) -> Split:
    """Return the split of a plan, with only the rounds whose ids are in `listed`.

    `side_of` contains the side of each planned round by id. Finished rounds in `folder` that were
    recovered from damaged files are listed as recovered. Raises DatasetError for a damaged round.
    """
    ids = [round_id for round_id in side_of if round_id in listed]
    states = read_states(folder)
    finished = (open_round(folder / states[i].file, ()) for i in ids if i in states)
    return Split(
        **{side: tuple(i for i in ids if side_of[i] == side) for side in SIDES},
        recovered=tuple(index.header.id for index in finished if index.recovery is not None),
    )


def rebuild(folder: Path, split: Split) -> dict[str, Any]:
    """Write `split`, and manifest, statistics and card computed from the rounds; return the
    statistics."""
    write_split(split_path(folder), split)
    end_merge(folder)
    dataset = Dataset.open(folder)
    statistics = describe(dataset)
    write_if_changed(folder / "stats.json", to_json(statistics))
    write_if_changed(folder / "README.md", render_card(dataset, statistics))
    write_if_changed(folder / MANIFEST, to_json(build_manifest(dataset)))
    return statistics
