"""Writes a dataset as WebDataset shards: `train-000000.tar` and so on, two files per frame.

KEY.jpg (KEY.png in lossless rounds) is the recorded image, byte for byte. KEY.json has the frame's
labels, state and command; `sample.schema.json` beside the shards describes each of its values.
The same dataset gives the same bytes. Source: github.com/webdataset/webdataset.
"""

import io
import json
import tarfile
from collections.abc import Iterator
from itertools import accumulate
from pathlib import Path
from typing import Any

import numpy as np

from datagen.export.split_sides import Progress, Side
from datagen.recording.round_metadata import RoundInfo
from datagen.recording.schema.json_schema import json_schema
from datagen.view.steps import Step, values

SUFFIX = {"jpeg": "jpg", "png": "png"}
SCHEMA_FILE = "sample.schema.json"
SHUFFLE_SEED = 0
TAR_FORMAT = tarfile.PAX_FORMAT  # equals USTAR except for file names of over 100 characters


def write(
    folder: Path, parts: list[Side], shard_size: int, shuffle: bool, progress: Progress
) -> None:
    """Write the shards of the sides `parts`, `shard_size` frames each, into `folder`.

    With `shuffle` the frames of a side are in a fixed random order. `progress` is called with the
    number of frames written so far.
    """
    (folder / SCHEMA_FILE).write_text(json.dumps(sample_schema(), indent=1) + "\n")
    done = 0
    for side in parts:
        samples = _samples(side, shuffle)
        for number, first in enumerate(range(0, side.frames, shard_size)):
            size = min(shard_size, side.frames - first)
            path = folder / f"{side.name}-{number:06d}.tar"
            with tarfile.open(path, "w", format=TAR_FORMAT) as shard:
                for _, (info, step, codec) in zip(range(size), samples, strict=False):
                    _add_sample(shard, info, step, codec)
            done += size
            progress(done)


def _samples(side: Side, shuffle: bool) -> Iterator[tuple[RoundInfo, Step, str]]:
    rounds = list(side.open())
    first = np.array(list(accumulate((len(steps) for _, steps in rounds), initial=0)))
    order = np.arange(first[-1])
    if shuffle:
        order = np.random.default_rng(SHUFFLE_SEED).permutation(order)
    for i in order.tolist():
        number = int(np.searchsorted(first, i, side="right")) - 1
        info, steps = rounds[number]
        yield info, steps[i - int(first[number])], steps.index.header.codec


def _add_sample(shard: tarfile.TarFile, info: RoundInfo, step: Step, codec: str) -> None:
    # WebDataset ends a key at the first dot. No name of a round contains "%".
    key = f"{info.path.stem.replace('.', '%2E')}-{step.number:06d}"
    _add(shard, f"{key}.{SUFFIX[codec]}", bytes(step.image))
    _add(shard, f"{key}.json", json.dumps(sample(info, step)).encode())


def sample(info: RoundInfo, step: Step) -> dict[str, Any]:
    """Return the content of KEY.json for the frame `step` of the round `info`. Absent distances are
    None (null)."""
    return {
        "round": info.id,
        "frame": step.number,
        "time_s": step.time_s,
        "split": info.split,
        "track": info.track,
        "light": step.light,
        "labels": values(step.labels),
        "ego": values(step.ego),
        "command": values(step.command),
    }


def _add(shard: tarfile.TarFile, name: str, data: bytes) -> None:
    entry = tarfile.TarInfo(name)  # time, owner and mode keep their constant defaults
    entry.size = len(data)
    shard.addfile(entry, io.BytesIO(data))


def sample_schema() -> dict[str, Any]:
    """Return the JSON schema of KEY.json: the schema of the recorded messages, with null allowed
    for absent fields."""
    recorded = json_schema()
    text, count = {"type": "string"}, {"type": "integer", "minimum": 0}
    parts = {
        "round": text | {"description": "id of the round; frames of a round are similar"},
        "frame": count | {"description": "number of the frame in its round"},
        "time_s": {"type": "number", "description": "since the start of the round", "x-unit": "s"},
        "split": text,
        "track": text,
        "light": text,
        "labels": _nullable(recorded["$defs"]["TrackFeatures"]),
        "ego": recorded["$defs"]["VehicleState"],
        "command": recorded["$defs"]["Command"],
    }
    return {
        "$schema": recorded["$schema"],
        "title": "a sample of a driverview export",
        "description": "null: the value does not exist there, it is not zero",
        "x-definitions-version": recorded["x-definitions-version"],
        "type": "object",
        "properties": parts,
        "required": list(parts),
        "additionalProperties": False,
    }


def _nullable(message: dict[str, Any]) -> dict[str, Any]:
    fields = {name: dict(field) for name, field in message["properties"].items()}
    for field in fields.values():
        if "x-absent" in field:
            field["type"] = [field["type"], "null"]
        if "enum" in field:
            field["enum"] = [name.lower() for name in field["enum"]]
    return message | {"properties": fields, "required": list(fields)}
