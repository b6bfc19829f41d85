"""How good a model's answers are, in metres and radians, beside always answering the mean.

Errors are taken on active labels only (`mtlnet.errors`); how often presence itself is wrong stands
beside them.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

import trackfeatures as tf
from datagen.recording import Dataset, Frames, Labels
from mtlnet.answer import OUTPUTS
from mtlnet.doubt import FEATURES
from mtlnet.errors import Numbers, Truth, calibration, confusion, coverage, signed_errors, spread
from mtlnet.groups import groups


def describe_data(
    dataset: Dataset, frames: Frames, held_out: Frames | None = None
) -> dict[str, Any]:
    """What a model was trained on, and the mean of its labels: the answer of one who guesses.

    `held_out`: rounds on which only its doubt was fitted; it has seen them all the same.
    """
    rounds = [*frames.rounds, *(held_out.rounds if held_out is not None else [])]
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
        "mean": mean_answer(frames.labels),
    }


def mean_answer(labels: Truth) -> dict[str, Any]:
    """The mean of labels: the answer of one who guesses. None where nothing is labelled."""
    distances = labels.distances.astype(np.float64)
    counts = (~np.isnan(distances)).sum(0)
    sums = np.nansum(distances, axis=0)
    offset = tf.localise(distances)
    classes = np.bincount(labels.heading, minlength=len(tf.Heading))
    return {
        "distances_m": [float(s / n) if n else None for s, n in zip(sums, counts, strict=True)],
        "to_lane_centre_m": float(np.nanmean(offset)) if not np.isnan(offset).all() else 0.0,
        "angle_rad": float(labels.angle.astype(np.float64).mean()),
        "heading": int(classes.argmax()),
        "heading_share": [float(share) for share in classes / classes.sum()],
    }


def judge(outputs: NDArray[np.float32], labels: Labels, mean: dict[str, Any]) -> dict[str, Any]:
    """The report (DESIGN §9) on `outputs` (N, 9 or 17) for `labels`, `mean` as of `describe_data`.

    `doubt` is there where the model gives standard deviations.
    """
    errors = signed_errors(outputs, labels.distances, labels.angle)
    said = outputs[:, 6:OUTPUTS].argmax(1)
    model = _means(errors, said == labels.heading)
    guess = _means(_constant_errors(mean, labels), labels.heading == mean["heading"])
    report = {
        "frames": len(labels),
        **model,
        "errors": spread(errors),
        "confusion": confusion(labels.heading, said),
        "coded": coded_losses(outputs, labels),
        "presence": presence(outputs, labels),
        "baseline": guess,
        "ratio": _ratios(model, guess),
    }
    if outputs.shape[1] > OUTPUTS:
        std, novelty = outputs[:, OUTPUTS:-1], outputs[:, -1]
        strange = float((~(novelty <= 1)).mean())
        report["doubt"] = {"coverage": coverage(std, errors), "out_of_distribution": strange}
    return report


def judge_all(outputs: NDArray[np.float32], frames: Frames, mean: dict[str, Any]) -> dict[str, Any]:
    """The report on all frames, and the same by each of `mtlnet.groups.groups`: `by_track`, ..."""
    labels = frames.labels
    report = judge(outputs, labels, mean)
    if outputs.shape[1] > OUTPUTS:
        errors = signed_errors(outputs, labels.distances, labels.angle)
        report["doubt"]["calibration"] = calibration(outputs[:, OUTPUTS:-1], errors)
    for name, parts in groups(frames):
        report[name] = {
            key: judge(outputs[rows], labels.take(rows), mean) for key, rows in parts.items()
        }
    return report


def _means(errors: Numbers, right: NDArray[np.bool_]) -> dict[str, Any]:
    """Mean absolute errors, and the share of right classes, under the names of DESIGN §9."""
    sizes = [_mean(np.abs(column)) for column in errors.T]
    by_name = dict(zip(FEATURES, sizes, strict=True))
    return {
        "mae_m": {m: by_name[m] for m in tf.MARKINGS},
        "to_lane_centre_mae_m": by_name["to_lane_centre"],
        "angle_mae_rad": by_name["angle"],
        "heading_accuracy": _mean(right.astype(np.float64)),
    }


def _ratios(model: dict[str, Any], guess: dict[str, Any]) -> dict[str, Any]:
    return {
        "mae_m": {m: _ratio(model["mae_m"][m], guess["mae_m"][m]) for m in tf.MARKINGS},
        **{k: _ratio(model[k], guess[k]) for k in ("to_lane_centre_mae_m", "angle_mae_rad")},
    }


def coded_losses(outputs: NDArray[np.float32], labels: Labels) -> dict[str, float]:
    """The losses of the paper's table on coded values, inactive ones included.

    `distance`, `angle`: mean over the frames of the squared error, of the five distances summed, as
    trained; `distance_absolute`, `angle_absolute`: of the absolute error; `type`: cross-entropy.
    """
    target = tf.encode(labels.distances, labels.angle).astype(np.float64)
    difference = outputs[:, :6] - target
    squared, absolute = difference**2, np.abs(difference)
    chosen = outputs[np.arange(len(labels)), 6 + labels.heading].astype(np.float64)
    return {
        "distance": float(squared[:, :5].sum(1).mean()),
        "angle": float(squared[:, 5].mean()),
        "type": float(-np.log(np.maximum(chosen, 1e-12)).mean()),
        "distance_absolute": float(absolute[:, :5].sum(1).mean()),
        "angle_absolute": float(absolute[:, 5].mean()),
    }


def presence(outputs: NDArray[np.float32], labels: Labels) -> dict[str, dict[str, float | None]]:
    """Per distance: share of active labels answered as absent, and of absent ones as active."""
    distances, _ = tf.decode(outputs[:, :6])
    truth = labels.distances
    absent = np.isnan(np.column_stack([distances, tf.localise(distances)]))
    truly_absent = np.isnan(np.column_stack([truth, tf.localise(truth)]))
    return {
        name: {
            "false_inactive": _mean(absent[~truly_absent[:, i], i].astype(np.float64)),
            "false_active": _mean(1.0 - absent[truly_absent[:, i], i]),
        }
        for i, name in enumerate(FEATURES[:-1])
    }


def _constant_errors(mean: dict[str, Any], labels: Labels) -> Numbers:
    """Errors (N, 7) of always answering the training mean."""
    distances = [np.nan if d is None else d for d in mean["distances_m"]]
    offset = mean["to_lane_centre_m"] - tf.localise(labels.distances)
    angle = mean["angle_rad"] - labels.angle
    return np.column_stack([np.array(distances) - labels.distances, offset, angle])


def _mean(values: Numbers) -> float | None:
    """The mean of what is there; None where nothing is."""
    present = values[~np.isnan(values)]
    return float(present.mean()) if len(present) else None


def _ratio(value: float | None, reference: float | None) -> float | None:
    return value / reference if value is not None and reference else None
