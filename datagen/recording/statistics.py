"""Computes frame counts and label statistics of a dataset, a baseline for a model's errors."""

from collections import Counter
from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray

import trackfeatures as tf
from datagen.recording.dataset import Dataset
from datagen.recording.labels import Labels
from datagen.recording.names import SIDES


def describe(dataset: Dataset) -> dict[str, Any]:
    """Compute frame counts by track, lane count, light, traffic and trajectory, and the label
    statistics of all frames and of each side (see `describe_labels`)."""
    frames = dataset.select("all")
    labels, rounds = frames.labels, frames.rounds
    side = np.array([info.split for info in rounds])[labels.round]
    return {
        "definitions": tf.VERSION,
        "content_hash": dataset.content_hash,
        "rounds": len(rounds),
        "frames": len(labels),
        "camera": dataset.camera.as_dict(),
        "seeds": sorted({info.seed for info in rounds}),
        "by_track": _frames_by(rounds, "track_group"),
        "by_lanes": _frames_by(rounds, "lanes"),
        "by_light": dict(sorted(Counter(labels.light.tolist()).items())),
        "by_traffic": _frames_by(rounds, "traffic"),
        "by_trajectory": _frames_by(rounds, "trajectory"),
        "all": describe_labels(labels),
        **{name: describe_labels(labels.take(np.flatnonzero(side == name))) for name in SIDES},
    }


def describe_labels(labels: Labels) -> dict[str, Any]:
    """Compute statistics of `labels`: distances in m, angles in rad, speeds in km/h.

    `mean_deviation` is the mean absolute error of always predicting the mean; `active` is the share
    of frames in which a label is present.
    """
    if not len(labels):
        return {"frames": 0}
    columns = dict(zip(tf.MARKINGS, labels.distances.T, strict=True))
    columns["to_lane_centre"] = labels.to_lane_centre
    columns["angle"] = labels.angle
    counts = np.bincount(labels.heading, minlength=len(tf.RoadClass)) / len(labels)
    return {
        "frames": len(labels),
        "heading": {kind.name.lower(): round(float(counts[kind]), 4) for kind in tf.RoadClass},
        "active": {n: round(float(np.mean(~np.isnan(c))), 4) for n, c in columns.items()},
        "mean": {n: _mean(c) for n, c in columns.items()},
        "mean_deviation": {n: _mean(np.abs(c - _mean(c))) for n, c in columns.items()},
        "angle_std": round(float(labels.angle.std()), 5),
        "to_middle_m": _range(labels.to_middle),
        "speed_kmh": _range(labels.speed * 3.6),
        "shadow_fraction": _mean(labels.shadow_fraction),
    }


def _mean(values: NDArray[np.float32]) -> float:
    present = values[~np.isnan(values)]
    return round(float(present.mean()), 5) if present.size else 0.0


def _range(values: NDArray[np.float32]) -> dict[str, float]:
    low, middle, high = (round(float(v), 3) for v in np.percentile(values, [0, 50, 100]))
    return {"min": low, "median": middle, "max": high}


def _frames_by(rounds: Iterable[Any], name: str) -> dict[str, int]:
    counts: Counter[str] = Counter()
    for info in rounds:
        counts[str(getattr(info, name))] += info.frames
    return dict(sorted(counts.items()))
