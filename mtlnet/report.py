"""How good a model's answers are, in metres and radians, beside always answering the mean.

Errors are taken on active labels only, on the value the network gives whether or not it decodes to
"absent"; how often presence itself is wrong stands beside them.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

import trackfeatures as tf
from datagen.recording import Dataset, Frames, Labels

Numbers = NDArray[np.float64]


def describe_data(
    dataset: Dataset, frames: Frames, held_out: Frames | None = None
) -> dict[str, Any]:
    """What a model was trained on, and the mean of its labels: the answer of one who guesses.

    `held_out`: rounds on which only its doubt was fitted; it has seen them all the same.
    """
    rounds = [*frames.rounds, *(held_out.rounds if held_out is not None else [])]
    labels = frames.labels
    distances = labels.distances.astype(np.float64)
    counts = (~np.isnan(distances)).sum(0)
    sums = np.nansum(distances, axis=0)
    classes = np.bincount(labels.heading, minlength=len(tf.Heading))
    sides = {
        side: [info.id for info in dataset.rounds if info.split == side]
        for side in ("train", "test")
    }
    return {
        "path": str(dataset.path),
        "content_hash": dataset.content_hash,
        "frames": len(frames),
        "split": sides,
        "held_out": [info.id for info in held_out.rounds] if held_out is not None else [],
        "seeds": [info.seed for info in rounds],
        "tracks": sorted({info.track for info in rounds}),
        "mean": {
            "distances_m": [float(s / n) if n else None for s, n in zip(sums, counts, strict=True)],
            "to_lane_centre_m": float(np.nanmean(tf.localise(distances))),
            "angle_rad": float(labels.angle.astype(np.float64).mean()),
            "heading": int(classes.argmax()),
            "heading_share": [float(share) for share in classes / classes.sum()],
        },
    }


def judge(outputs: NDArray[np.float32], labels: Labels, mean: dict[str, Any]) -> dict[str, Any]:
    """The report (DESIGN §9) on `outputs` (N, 9) for `labels`, `mean` as `describe_data` has it."""
    model = errors(*_values(outputs), labels)
    guess = errors(*_constant(mean, len(labels)), labels)
    ratio = {
        "mae_m": {m: _ratio(model["mae_m"][m], guess["mae_m"][m]) for m in tf.MARKINGS},
        "to_lane_centre_mae_m": _ratio(
            model["to_lane_centre_mae_m"], guess["to_lane_centre_mae_m"]
        ),
        "angle_mae_rad": _ratio(model["angle_mae_rad"], guess["angle_mae_rad"]),
    }
    return {
        "frames": len(labels),
        **model,
        "coded": coded_losses(outputs, labels),
        "presence": presence(outputs, labels),
        "baseline": guess,
        "ratio": ratio,
    }


def errors(
    values: Numbers, offset: Numbers, heading: NDArray[np.int64], labels: Labels
) -> dict[str, Any]:
    """Mean absolute errors of values (N, 6) in m and rad, of the offset (N,), and the accuracy.

    The offset counts where both the label and the answer have one.
    """
    distance = np.abs(values[:, :5] - labels.distances)
    return {
        "mae_m": {m: _mean(distance[:, i]) for i, m in enumerate(tf.MARKINGS)},
        "to_lane_centre_mae_m": _mean(np.abs(offset - tf.localise(labels.distances))),
        "angle_mae_rad": _mean(np.abs(values[:, 5] - labels.angle)),
        "heading_accuracy": _mean((heading == labels.heading).astype(np.float64)),
    }


def coded_losses(outputs: NDArray[np.float32], labels: Labels) -> dict[str, float]:
    """The three losses of the paper, as they are trained (see `mtlnet.loss`)."""
    target = tf.encode(labels.distances, labels.angle).astype(np.float64)
    squared = (outputs[:, :6] - target) ** 2
    chosen = outputs[np.arange(len(labels)), 6 + labels.heading].astype(np.float64)
    return {
        "distance": float(squared[:, :5].sum(1).mean()),
        "angle": float(squared[:, 5].mean()),
        "type": float(-np.log(np.maximum(chosen, 1e-12)).mean()),
    }


def presence(outputs: NDArray[np.float32], labels: Labels) -> dict[str, dict[str, float | None]]:
    """Per marking: share of active labels answered as absent, and of absent ones as active."""
    distances, _ = tf.decode(outputs[:, :6])
    absent, truly_absent = np.isnan(distances), np.isnan(labels.distances)
    return {
        marking: {
            "missed": _mean(absent[~truly_absent[:, i], i].astype(np.float64)),
            "invented": _mean(1.0 - absent[truly_absent[:, i], i]),
        }
        for i, marking in enumerate(tf.MARKINGS)
    }


def judge_groups(
    outputs: NDArray[np.float32], frames: Frames, mean: dict[str, Any]
) -> dict[str, dict[str, Any]]:
    """The report by track and by lane count: {"by_track": {...}, "by_lanes": {...}}."""
    labels = frames.labels
    tracks = np.array([info.track for info in frames.rounds])[labels.round]
    groups = {"by_track": tracks, "by_lanes": labels.lanes.astype(str)}
    report: dict[str, dict[str, Any]] = {}
    for group, keys in groups.items():
        report[group] = {}
        for key in np.unique(keys).tolist():
            rows = np.flatnonzero(keys == key)
            report[group][key] = judge(outputs[rows], labels.take(rows), mean)
    return report


def _values(outputs: NDArray[np.float32]) -> tuple[Numbers, Numbers, NDArray[np.int64]]:
    distances, _ = tf.decode(outputs[:, :6])
    return tf.decode_values(outputs[:, :6]), tf.localise(distances), outputs[:, 6:9].argmax(1)


def _constant(mean: dict[str, Any], count: int) -> tuple[Numbers, Numbers, NDArray[np.int64]]:
    distances = [np.nan if d is None else d for d in mean["distances_m"]]
    values = np.tile([*distances, mean["angle_rad"]], (count, 1))
    return (
        values,
        np.full(count, mean["to_lane_centre_m"]),
        np.full(count, mean["heading"], dtype=np.int64),
    )


def _mean(values: Numbers) -> float | None:
    """The mean of what is there; None where nothing is."""
    present = values[~np.isnan(values)]
    return float(present.mean()) if len(present) else None


def _ratio(value: float | None, reference: float | None) -> float | None:
    return value / reference if value is not None and reference else None
