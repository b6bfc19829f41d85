"""Errors of a model's outputs on labelled frames, in m and rad, feature by feature.

A feature is one of `mtlnet.doubt.FEATURES`: the five markings, `to_lane_centre`, `angle`. Errors
are signed (answer minus truth), and NaN where the label has none: what is not active is not judged.
"""

from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

import trackfeatures as tf
from mtlnet.doubt import FEATURES

Numbers = NDArray[np.float64]
PERCENTILES = {"median": 50, "p95": 95, "p99": 99}
CALIBRATION_BINS = 10


class Truth(Protocol):
    """The labels that errors need; see `datagen.recording.Labels`."""

    @property
    def distances(self) -> NDArray[np.float32]: ...
    @property
    def angle(self) -> NDArray[np.float32]: ...
    @property
    def heading(self) -> NDArray[np.int64]: ...


def signed_errors(outputs: NDArray[np.float32], distances: Any, angle: Any) -> Numbers:
    """Errors (N, 7) of outputs (N, 9 or more).

    A marking's is that of the value the network gives, whether or not it decodes to "absent"; that
    of `to_lane_centre` counts where both the label and the answer have one.
    """
    values = tf.decode_values(outputs[:, :6])
    offset = tf.localise(tf.decode(outputs[:, :6])[0]) - tf.localise(distances)
    columns = [values[:, :5] - distances, offset[:, None], (values[:, 5] - angle)[:, None]]
    return np.concatenate(columns, axis=1)


def spread(errors: Numbers) -> dict[str, dict[str, float | None]]:
    """By feature: mean, median, 95th and 99th percentile of the absolute error, how many frames."""
    return {name: _spread(np.abs(errors[:, i])) for i, name in enumerate(FEATURES)}


def _spread(sizes: Numbers) -> dict[str, float | None]:
    present = sizes[~np.isnan(sizes)]
    if not len(present):
        return {"mean": None, **dict.fromkeys(PERCENTILES), "frames": 0}
    found = np.percentile(present, list(PERCENTILES.values())).tolist()
    percentiles = dict(zip(PERCENTILES, found, strict=True))
    return {"mean": float(present.mean()), **percentiles, "frames": len(present)}


def confusion(heading: NDArray[np.int64], said: NDArray[np.int64]) -> dict[str, dict[str, int]]:
    """Frames by true class, then by the class that was said."""
    names = [kind.name.lower() for kind in tf.Heading]
    counts = np.zeros((len(names), len(names)), np.int64)
    np.add.at(counts, (heading, said), 1)
    return {
        name: dict(zip(names, row, strict=True))
        for name, row in zip(names, counts.tolist(), strict=True)
    }


def coverage(std: NDArray[Any], errors: NDArray[Any]) -> dict[str, list[float | None]]:
    """By feature: shares of errors within one and two standard deviations (N, 7).

    Of a normal distribution 0.683 and 0.954.
    """
    ratio = np.abs(errors) / std
    return {name: [_within(ratio[:, i], k) for k in (1, 2)] for i, name in enumerate(FEATURES)}


def _within(ratio: NDArray[Any], limit: float) -> float | None:
    present = ratio[~np.isnan(ratio)]
    return float((present <= limit).mean()) if len(present) else None


def calibration(std: NDArray[Any], errors: Numbers) -> dict[str, list[dict[str, float]]]:
    """By feature: the errors found where a standard deviation was said, in bins of equal count.

    Each bin: root mean square of the said deviations, that of the errors, frames.
    """
    return {name: _bins(std[:, i], errors[:, i]) for i, name in enumerate(FEATURES)}


def _bins(std: NDArray[Any], errors: Numbers) -> list[dict[str, float]]:
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
