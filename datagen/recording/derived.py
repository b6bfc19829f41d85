"""The derived parts of a dataset folder: manifest, split, statistics and the dataset card."""

import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

import trackfeatures as tf

from .dataset import Dataset
from .folder import read_states, write_synced
from .splits import Split, split_path, write_split
from .statistics import describe

CARD = """# {name}: driver-view images and track features

Recorded by `datagen collect` of driverview, definitions {definitions}. One MCAP file a round
(`rounds/`): {frames} frames in {rounds} rounds, {width} x {height} px, with {fov:g} degrees of
vertical field of view.

Read it with `datagen.recording.Dataset`, with any MCAP reader (schemas are inside the files; the
`.proto` files are in `proto/`), or look at it in Foxglove with `layouts/foxglove.json`.
Images carry the time of their labels: the messages of one control step share one log time, which is
simulated time counted from 2020-01-01. Check it with `datagen verify`.

| | all | train | test |
|---|---|---|---|
{table}

Frames by track: {tracks}.
By lanes: {lanes}. By light: {lights}.

Splits are by round (`splits/default.json`); test rounds have seeds that no training round has.
"Mean deviation" is the error of always answering the mean: a model must do better than that.
All of it is simulated: cars, roads and weather are those of this program, not of the world.
"""


def rebuild(folder: Path, split: Split) -> dict[str, Any]:
    """Write manifest, split, statistics and card from the rounds; returns the statistics."""
    write_split(split_path(folder), split)
    dataset = Dataset.open(folder)
    statistics = describe(dataset)
    write_synced(folder / "stats.json", _json(statistics))
    write_synced(folder / "manifest.json", _json(_manifest(dataset)))
    write_synced(folder / "README.md", _card(dataset, statistics))
    return statistics


def _manifest(dataset: Dataset) -> dict[str, Any]:
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
    return {
        "definitions": tf.VERSION,
        "content_hash": dataset.content_hash,
        "frames": sum(info.frames for info in dataset.rounds),
        "rounds": rounds,
    }


def _card(dataset: Dataset, statistics: dict[str, Any]) -> str:
    return CARD.format(
        name=dataset.path.resolve().name,
        definitions=tf.VERSION,
        frames=statistics["frames"],
        rounds=statistics["rounds"],
        width=dataset.camera.width,
        height=dataset.camera.height,
        fov=dataset.camera.fov_y_deg,
        table="\n".join(_rows(statistics)),
        tracks=_counts(statistics["by_track"]),
        lanes=_counts(statistics["by_lanes"]),
        lights=_counts(statistics["by_light"]),
    )


def _rows(statistics: dict[str, Any]) -> list[str]:
    sides = [statistics[side] for side in ("all", "train", "test")]
    rows = [_row("frames", [str(side["frames"]) for side in sides])]
    full = [side if side["frames"] else None for side in sides]
    for kind in tf.Heading:
        name = kind.name.lower()
        rows.append(_row(name, [f"{s['heading'][name]:.1%}" if s else "" for s in full]))
    for name in (*tf.MARKINGS, "to_lane_centre", "angle"):
        unit = "rad" if name == "angle" else "m"
        cells = [
            f"{s['mean_deviation'][name]:.3f} {unit} ({s['active'][name]:.0%} active)" if s else ""
            for s in full
        ]
        rows.append(_row(f"mean deviation of {name}", cells))
    return rows


def _row(name: str, cells: list[str]) -> str:
    return f"| {name} | {' | '.join(cells)} |"


def _counts(counts: dict[str, int]) -> str:
    return ", ".join(f"{name} {count}" for name, count in counts.items())


def _json(content: dict[str, Any]) -> str:
    return json.dumps(content, indent=1) + "\n"
