"""Describes training data for a model's card; the mean labels are the baseline of evaluations."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

import trackfeatures as tf
from datagen.recording import Dataset, Frames
from mtlnet.data.loader import LabelArrays
from mtlnet.inference.trained_rounds import Seeds, names_entry
from trackfeatures.road_class import UNKNOWN_HEADING


def describe_data(
    dataset: Dataset, frames: Frames, held_out: Frames | None = None
) -> dict[str, Any]:
    """Return a description of a model's training data, `frames` of `dataset`, for its model card.

    The entry `mean` has the mean labels, with which evaluations compare the model: they are the
    constant answer of the baseline. `held_out`: frames of rounds on which only the uncertainty head
    was fitted. Their seeds and tracks count as seen by the model, but the entry `frames` does not
    count them. The format of the entries `split`, `held_out` and `seeds` is defined in
    `mtlnet.inference.trained_rounds`.
    """
    fitted = held_out.rounds if held_out is not None else []
    rounds = [*frames.rounds, *fitted]
    splits = {
        split: names_entry(info.id for info in dataset.rounds if info.split == split)
        for split in ("train", "test")
    }
    return {
        "path": str(dataset.path),
        "content_hash": dataset.content_hash,
        "camera": dataset.camera.as_dict(),
        "frames": len(frames),
        "split": splits,
        "held_out": names_entry(info.id for info in fitted),
        "seeds": Seeds.of(info.seed for info in rounds).entry(),
        "tracks": sorted({info.track for info in rounds}),
        "mean": mean_labels(frames.labels),
    }


def mean_labels(labels: LabelArrays) -> dict[str, Any]:
    """Return the means of the labels in m and rad, their most frequent class, and the share of each
    class.

    The mean of a marking that is never present is None.
    """
    distances = nan_where_unknown(labels.distances.astype(np.float64))
    counts = (~np.isnan(distances)).sum(0)
    sums = np.nansum(distances, axis=0)
    offset = nan_where_unknown(tf.localise(distances))
    known = labels.heading[labels.heading != UNKNOWN_HEADING]
    classes = np.bincount(known, minlength=len(tf.RoadClass))
    return {
        "distances_m": [float(s / n) if n else None for s, n in zip(sums, counts, strict=True)],
        "to_lane_centre_m": float(np.nanmean(offset)) if not np.isnan(offset).all() else 0.0,
        "angle_rad": float(labels.angle.astype(np.float64).mean()),
        "heading": int(classes.argmax()),
        "heading_share": [float(share) for share in classes / max(classes.sum(), 1)],
    }


def nan_where_unknown(metres: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return `metres` with NaN in place of infinity, which stands for an unknown label
    (`trackfeatures.coding`). The shape is kept."""
    return np.where(np.isinf(metres), np.nan, metres)
