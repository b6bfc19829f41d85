"""`manifest.json`: the rounds of a dataset folder, their hashes and those of the files beside them.

It is derived: the rounds and their states say the same, so that damage in it can be seen.
"""

import json
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any

import trackfeatures as tf
from datagen.recording.card import card
from datagen.recording.dataset import Dataset
from datagen.recording.folder import PUBLISHED, file_sha256, read_states, write_if_changed
from datagen.recording.splits import Split, split_path, write_split
from datagen.recording.statistics import describe

MANIFEST = "manifest.json"
# The dataset card is not among them: people write into it.
HASHED = (*PUBLISHED, "plan.json", "stats.json")


def describe_folder(dataset: Dataset) -> dict[str, Any]:
    """The content of the manifest; needs the states of the rounds and the published files."""
    states = read_states(dataset.path)
    rounds = []
    for info, index in zip(dataset.rounds, dataset.indexes, strict=True):
        state = states.get(info.id)
        rounds.append(
            {
                **asdict(index.header),
                **asdict(index.result),
                "split": info.split,
                "file": f"rounds/{info.path.name}",
                "bytes": info.path.stat().st_size,
                "sha256": state.sha256 if state else None,
            }
        )
    paths = {name: dataset.path / name for name in HASHED}
    return {
        "definitions": tf.VERSION,
        "content_hash": dataset.content_hash,
        "frames": sum(info.frames for info in dataset.rounds),
        "files": {name: file_sha256(path) for name, path in paths.items() if path.is_file()},
        "rounds": rounds,
    }


def as_text(content: dict[str, Any]) -> str:
    return json.dumps(content, indent=1) + "\n"


def manifest_problems(folder: Path) -> Iterator[str]:
    """What in the manifest is not so; raises as `Dataset.open` does."""
    path = folder / MANIFEST
    mend = "the same `datagen collect` again writes it anew"
    if not path.is_file():
        yield f"there is no {path}; {mend}"
        return
    expected = describe_folder(Dataset.open(folder))
    data = path.read_bytes()
    if data == as_text(expected).encode():
        return
    try:
        found = json.loads(data)
        files, wanted = found["files"], expected["files"]
        changed = [name for name in {**wanted, **files} if files.get(name) != wanted.get(name)]
    except (ValueError, KeyError, TypeError, AttributeError):
        changed = []
    if changed:
        yield f"{', '.join(sorted(changed))} in {folder}: not what {MANIFEST} was written for"
    else:
        yield f"{path} does not describe the rounds that are there; {mend}"


# The derived parts of a dataset folder: manifest, split, statistics and the dataset card.


def rebuild(folder: Path, split: Split) -> dict[str, Any]:
    """Write manifest, split, statistics and card from the rounds; returns the statistics."""
    write_split(split_path(folder), split)
    dataset = Dataset.open(folder)
    statistics = describe(dataset)
    write_if_changed(folder / "stats.json", as_text(statistics))
    write_if_changed(folder / "README.md", card(dataset, statistics))
    write_if_changed(folder / MANIFEST, as_text(describe_folder(dataset)))
    return statistics
