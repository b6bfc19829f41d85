"""Computes metrics of a model's outputs on labelled frames: errors in m and rad, by feature.

A feature is one of `mtlnet.inference.prediction.FEATURES`: the five markings, `to_lane_centre` and
`angle`. An error is the predicted minus the true value; it is NaN, and not counted, where the label
is inactive (absent) or unknown. The baseline is a constant prediction, the mean of the training
labels.
"""

from collections.abc import Iterator
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

import trackfeatures as tf
from datagen.recording import Frames
from mtlnet.data.description import nan_where_unknown
from mtlnet.data.loader import LabelArrays
from mtlnet.inference.out_of_distribution import is_out_of_distribution
from mtlnet.inference.prediction import FEATURES, OUTPUTS, split_outputs
from trackfeatures.road_class import UNKNOWN_HEADING

PERCENTILES = {"median": 50, "p95": 95, "p99": 99}
CALIBRATION_BINS = 10


def signed_errors(outputs: NDArray[np.float32], distances: Any, angle: Any) -> NDArray[np.float64]:
    """Return the errors (N, 7) of a model's outputs (N, K; columns: `split_outputs`), m and rad, in
    the order of `FEATURES`. `distances` (N, 5), m, and `angle` (N,), rad, are the labels.

    The error of a marking is the error of the predicted value, even if the value decodes to
    "inactive". `to_lane_centre` has an error where both label and prediction have a value.
    """
    values = tf.decode_values(outputs[:, :6])
    offset = tf.localise(tf.decode(outputs[:, :6])[0]) - tf.localise(distances)
    columns = [values[:, :5] - distances, offset[:, None], (values[:, 5] - angle)[:, None]]
    return nan_where_unknown(np.concatenate(columns, axis=1))


def error_percentiles(errors: NDArray[np.float64]) -> dict[str, dict[str, float | None]]:
    """Return, for each feature by name, the mean, the median, and the 95th and 99th percentile of
    the absolute error (m or rad), and the number of frames that have an error.

    `errors` (N, 7): in the order of `FEATURES`, NaN where not evaluated.
    """
    return {name: _percentiles(np.abs(errors[:, i])) for i, name in enumerate(FEATURES)}


def _percentiles(sizes: NDArray[np.float64]) -> dict[str, float | None]:
    present = sizes[~np.isnan(sizes)]
    if not len(present):
        return {"mean": None, **dict.fromkeys(PERCENTILES), "frames": 0}
    found = np.percentile(present, list(PERCENTILES.values())).tolist()
    percentiles = dict(zip(PERCENTILES, found, strict=True))
    return {"mean": float(present.mean()), **percentiles, "frames": len(present)}


def confusion(
    heading: NDArray[np.int64], predicted: NDArray[np.int64]
) -> dict[str, dict[str, int]]:
    """Count the frames by true class `heading` (N,) and `predicted` class (N,); returns {true name:
    {predicted name: count}}. Frames of unknown class are not counted."""
    known = heading != UNKNOWN_HEADING
    heading, predicted = heading[known], predicted[known]
    names = [kind.name.lower() for kind in tf.RoadClass]
    counts = np.zeros((len(names), len(names)), np.int64)
    np.add.at(counts, (heading, predicted), 1)
    return {
        name: dict(zip(names, row, strict=True))
        for name, row in zip(names, counts.tolist(), strict=True)
    }


def coverage(std: NDArray[Any], errors: NDArray[Any]) -> dict[str, list[float | None]]:
    """Return, for each feature by name, the shares of its errors (N, 7) that are within one and
    within two of the predicted standard deviations (N, 7).

    For normally distributed errors the shares are 0.683 and 0.954.
    """
    ratio = np.abs(errors) / std
    within = [np.where(np.isnan(ratio), np.nan, ratio <= limit) for limit in (1, 2)]
    return {name: [_mean(each[:, i]) for each in within] for i, name in enumerate(FEATURES)}


def calibration(
    std: NDArray[Any], errors: NDArray[np.float64]
) -> dict[str, list[dict[str, float]]]:
    """Compare predicted standard deviations (N, 7) with errors (N, 7). For each feature by name,
    the frames are sorted by predicted standard deviation and divided into ten bins of equal count.

    Each bin has the root mean square of the predicted standard deviations ("said"), the root mean
    square of the errors ("found"), and the number of frames.
    """
    return {name: _bins(std[:, i], errors[:, i]) for i, name in enumerate(FEATURES)}


def _bins(std: NDArray[Any], errors: NDArray[np.float64]) -> list[dict[str, float]]:
    present = np.flatnonzero(~np.isnan(errors))
    order = present[np.argsort(std[present], kind="stable")]
    parts = np.array_split(order, min(CALIBRATION_BINS, max(len(order), 1)))
    return [
        {"said": _rms(std[part]), "found": _rms(errors[part]), "frames": len(part)}
        for part in parts
        if len(part)
    ]


def _rms(values: NDArray[Any]) -> float:
    return float(np.sqrt((values.astype(np.float64) ** 2).mean()))


# Groups of frames by which a model is evaluated.


GROUPS = {
    "by_track": "track",
    "by_lanes": "lanes",
    "by_light": "light",
    "by_shadow": "road in shadow",
    "by_radius": "radius of the bend",
    "by_speed": "speed",
}
SHADOW = (0.05, 0.3, 0.6)
"""Limits between the groups: share of the road within 30 m ahead that is in shadow."""
RADIUS_M = (40.0, 80.0, 170.0)
"""Limits between the groups, m. A larger radius than 170 m at the car's position does not count as
a bend; the class is then straight, unless there is a bend 20 m ahead."""
SPEED_KMH = (30.0, 45.0, 60.0)


def groups(frames: Frames) -> Iterator[tuple[str, dict[str, NDArray[np.int64]]]]:
    """Yield, for each grouping, its name in `GROUPS` and, by group, the indices of its frames.

    Each frame is in one group of every grouping.
    """
    labels = frames.labels
    of_round = labels.round
    yield "by_track", _by_value(np.array([info.track_group for info in frames.rounds])[of_round])
    yield "by_lanes", _by_value(labels.lanes.astype(str))
    yield "by_light", _by_value(labels.light)
    yield "by_shadow", _by_range(labels.shadow_fraction, SHADOW, "")
    radius = 1 / np.maximum(np.abs(labels.curvature), 1e-9)
    yield "by_radius", _by_range(radius, RADIUS_M, " m")
    yield "by_speed", _by_range(labels.speed * 3.6, SPEED_KMH, " km/h")


def _by_value(keys: NDArray[np.str_]) -> dict[str, NDArray[np.int64]]:
    return {key: np.flatnonzero(keys == key) for key in np.unique(keys).tolist()}


def _by_range(
    values: NDArray[Any], limits: tuple[float, ...], unit: str
) -> dict[str, NDArray[np.int64]]:
    names = [f"under {limits[0]:g}{unit}"]
    names += [f"{lo:g} to {hi:g}{unit}" for lo, hi in pairwise(limits)]
    names += [f"over {limits[-1]:g}{unit}"]
    numbers = np.digitize(values, limits)
    rows = {name: np.flatnonzero(numbers == i) for i, name in enumerate(names)}
    return {name: found for name, found in rows.items() if len(found)}


# The report of an evaluation.


def evaluate_outputs(
    outputs: NDArray[np.float32], labels: LabelArrays, mean: dict[str, Any]
) -> dict[str, Any]:
    """Return the report on a model's `outputs` (N, K; columns: `split_outputs`) for `labels`: mean
    absolute errors, percentiles, confusion of classes, losses, and the errors of the baseline.

    `mean`: the means of the training labels (`mtlnet.data.description.mean_labels`). The report has
    the key `uncertainty` when the model predicts standard deviations.
    """
    errors = signed_errors(outputs, labels.distances, labels.angle)
    heading = outputs[:, 6:OUTPUTS].argmax(1)
    known = labels.heading != UNKNOWN_HEADING
    model = _means(errors, (heading == labels.heading)[known])
    right = (labels.heading == mean["heading"])[known]
    baseline = _means(_baseline_errors(mean, labels), right)
    report = {
        "frames": len(labels.angle),
        **model,
        "errors": error_percentiles(errors),
        "confusion": confusion(labels.heading, heading),
        "coded": coded_losses(outputs, labels),
        "presence": presence(outputs, labels),
        "baseline": baseline,
        "ratio": _ratios(model, baseline),
    }
    parts = split_outputs(outputs)
    if parts.std is not None and parts.ood_score is not None:
        share = float(is_out_of_distribution(parts.ood_score).mean())
        report["uncertainty"] = {
            "coverage": coverage(parts.std, errors),
            "out_of_distribution": share,
        }
    return report


def evaluate_by_groups(
    outputs: NDArray[np.float32], frames: Frames, mean: dict[str, Any]
) -> dict[str, Any]:
    """Return the report of `evaluate_outputs` on all frames, extended by a report for each group of
    frames, under `by_track` and the other keys of `GROUPS`.

    `outputs` (N, K; columns: `split_outputs`); `mean`: the means of the training labels.
    """
    labels = frames.labels
    report = evaluate_outputs(outputs, labels, mean)
    std = split_outputs(outputs).std
    if std is not None:
        errors = signed_errors(outputs, labels.distances, labels.angle)
        report["uncertainty"]["calibration"] = calibration(std, errors)
    for name, parts in groups(frames):
        report[name] = {
            key: evaluate_outputs(outputs[rows], labels.take(rows), mean)
            for key, rows in parts.items()
        }
    return report


def _means(errors: NDArray[np.float64], right: NDArray[np.bool_]) -> dict[str, Any]:
    """Return the mean absolute errors of `errors` (N, 7), and the mean of `right`, the accuracy."""
    sizes = [_mean(np.abs(column)) for column in errors.T]
    by_name = dict(zip(FEATURES, sizes, strict=True))
    return {
        "mae_m": {m: by_name[m] for m in tf.MARKINGS},
        "to_lane_centre_mae_m": by_name["to_lane_centre"],
        "angle_mae_rad": by_name["angle"],
        "heading_accuracy": _mean(right.astype(np.float64)),
    }


def feature_mean(means: dict[str, Any], name: str) -> float | None:
    """Return the mean absolute error of feature `name` in `means`, a report or its entry
    `baseline`, or the ratio in its entry `ratio`. None if no frame has this error."""
    keys = {"to_lane_centre": "to_lane_centre_mae_m", "angle": "angle_mae_rad"}
    found: float | None = means[keys[name]] if name in keys else means["mae_m"][name]
    return found


def _ratios(model: dict[str, Any], baseline: dict[str, Any]) -> dict[str, Any]:
    return {
        "mae_m": {m: _ratio(model["mae_m"][m], baseline["mae_m"][m]) for m in tf.MARKINGS},
        **{k: _ratio(model[k], baseline[k]) for k in ("to_lane_centre_mae_m", "angle_mae_rad")},
    }


def coded_losses(outputs: NDArray[np.float32], labels: LabelArrays) -> dict[str, float | None]:
    """Return the losses of the paper's ablation table, on coded values, including inactive (absent)
    distances.

    `distance`: the sum of the squared errors of the five distances, averaged over the frames, as in
    training; `angle`: the mean squared error of the angle; `distance_absolute`, `angle_absolute`:
    like `distance` and `angle`, with absolute instead of squared errors; `type`: cross-entropy of
    the class, None where no frame has a known class.
    """
    target = tf.encode(labels.distances, labels.angle).astype(np.float64)
    known = ~np.isnan(target)
    difference = np.where(known, outputs[:, :6] - target, 0.0)
    squared, absolute = difference**2, np.abs(difference)
    weight = known[:, :5].size / max(known[:, :5].sum(), 1)  # the mean over the known distances
    told = np.flatnonzero(labels.heading != UNKNOWN_HEADING)
    likelihood = outputs[told, 6 + labels.heading[told]].astype(np.float64)
    type_loss = _mean(-np.log(np.maximum(likelihood, 1e-12)))
    return {
        "distance": float(weight * squared[:, :5].sum(1).mean()),
        "angle": float(squared[:, 5].mean()),
        "type": type_loss,
        "distance_absolute": float(weight * absolute[:, :5].sum(1).mean()),
        "angle_absolute": float(absolute[:, 5].mean()),
    }


def presence(
    outputs: NDArray[np.float32], labels: LabelArrays
) -> dict[str, dict[str, float | None]]:
    """Return, for each marking and `to_lane_centre` by name, the share of active labels that are
    predicted as inactive, and the share of inactive labels that are predicted as active."""
    distances, _ = tf.decode(outputs[:, :6])
    truth = labels.distances
    inactive = np.isnan(np.column_stack([distances, tf.localise(distances)]))
    true = np.column_stack([truth, tf.localise(truth)])
    truly_inactive, truly_active = np.isnan(true), np.isfinite(true)
    return {
        name: {
            "false_inactive": _mean(inactive[truly_active[:, i], i].astype(np.float64)),
            "false_active": _mean(1.0 - inactive[truly_inactive[:, i], i]),
        }
        for i, name in enumerate(FEATURES[:-1])
    }


def _baseline_errors(mean: dict[str, Any], labels: LabelArrays) -> NDArray[np.float64]:
    """Return the errors (N, 7) of always predicting `mean`."""
    distances = [np.nan if d is None else d for d in mean["distances_m"]]
    offset = mean["to_lane_centre_m"] - tf.localise(labels.distances)
    angle = mean["angle_rad"] - labels.angle
    return nan_where_unknown(
        np.column_stack([np.array(distances) - labels.distances, offset, angle])
    )


def _mean(values: NDArray[np.float64]) -> float | None:
    """Return the mean of the values that are not NaN; None when there are none."""
    present = values[~np.isnan(values)]
    return float(present.mean()) if len(present) else None


def _ratio(value: float | None, reference: float | None) -> float | None:
    return value / reference if value is not None and reference else None
