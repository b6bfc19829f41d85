"""The figures of an ablation, mean and spread over its seeds, and its training curves."""

from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

import numpy as np
from numpy.typing import NDArray

import trackfeatures as tf
from mtlnet.ablation import Row, Run, read_evaluation
from mtlnet.curves import CURVES, read_curves

# Name, heading, unit, digits, and which task it judges (index into alpha).
LOSSES = (
    ("distance_loss", "distance loss", "squared", 5, 0),
    ("distance_absolute", "distance loss", "absolute", 4, 0),
    ("angle_loss", "angle loss", "squared", 5, 1),
    ("angle_absolute", "angle loss", "absolute", 5, 1),
    ("accuracy", "type accuracy", "%", 2, 2),
)
ERRORS = (
    *((marking, marking, "m", 3, 0) for marking in tf.MARKINGS),
    ("to_lane_centre", "to lane centre", "m", 3, 0),
    ("angle", "angle", "rad", 4, 1),
)
COLUMNS = LOSSES + ERRORS
# After which columns the paper's figures stand: it does not say how its losses are taken.
PAPER_COLUMNS = ("distance_absolute", "angle_absolute", "accuracy")
POINTS = 120  # of a curve


def figures(result: dict[str, Any]) -> dict[str, float | None]:
    """What the table says of one evaluation, for each of `COLUMNS`."""
    return {
        "distance_loss": result["coded"]["distance"],
        "distance_absolute": result["coded"]["distance_absolute"],
        "angle_loss": result["coded"]["angle"],
        "angle_absolute": result["coded"]["angle_absolute"],
        "accuracy": result["heading_accuracy"],
        **{marking: result["mae_m"][marking] for marking in tf.MARKINGS},
        "to_lane_centre": result["to_lane_centre_mae_m"],
        "angle": result["angle_mae_rad"],
    }


def table(rows: Sequence[Row], runs: Sequence[Run]) -> list[dict[str, Any]]:
    """One entry a row: {"row", "seeds", "figures": {column: {"mean", "std", "values"} or None}}.

    A column is None where the row did not learn that task. `std` is the sample standard deviation
    over the seeds, None of a single one.
    """
    entries = []
    for row in rows:
        found = [(run.seed, read_evaluation(run.folder)) for run in runs if run.row == row]
        done = [(seed, result) for seed, result in found if result is not None]
        each = [figures(result) for _, result in done]
        entries.append(
            {
                "row": asdict(row),
                "seeds": [seed for seed, _ in done],
                "frames": done[0][1]["frames"] if done else None,
                "figures": {
                    name: _spread([f[name] for f in each]) if row.alpha[task] > 0 else None
                    for name, _, _, _, task in COLUMNS
                },
            }
        )
    return entries


def best(entries: Sequence[dict[str, Any]], column: str) -> int | None:
    """The entry that is best in a column, by its mean; None while there is none."""
    means = [
        (entry["figures"][column] or {}).get("mean", None) if entry["seeds"] else None
        for entry in entries
    ]
    present = [(mean, i) for i, mean in enumerate(means) if mean is not None]
    if not present:
        return None
    return (max if column == "accuracy" else min)(present)[1]


def training_curve(
    runs: Sequence[Run], row: Row, task: str
) -> tuple[NDArray[np.float64], NDArray[np.float64]] | None:
    """Steps (P,) and losses (seeds, P) of a task in training; None without a finished run.

    Each point is the mean of an equal share of the logged ones: the loss of a batch jumps.
    """
    series = []
    for run in runs:
        points = read_curves(run.folder / CURVES) if run.row == row else []
        if points and run.state == "finished":
            series.append(np.array([[p["step"], p[f"{task}_loss"]] for p in points]))
    if not series:
        return None
    length = min(len(points) for points in series)
    chunks = np.array_split(np.arange(length), min(POINTS, length))
    steps = np.array([series[0][chunk, 0].max() for chunk in chunks])
    return steps, np.array([[p[chunk, 1].mean() for chunk in chunks] for p in series])


def _spread(values: list[float | None]) -> dict[str, Any] | None:
    present = [value for value in values if value is not None]
    if not present:
        return None
    std = float(np.std(present, ddof=1)) if len(present) > 1 else None
    return {"mean": float(np.mean(present)), "std": std, "values": present}
