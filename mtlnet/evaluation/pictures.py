"""Evaluates a model on a user's own labelled pictures: `mtlnet evaluate --data FOLDER`.

Lengths in m, the angle in rad. Errors are counted only where the model's answer has a value; absent
answers are counted separately, and so are pictures that show too little of the model's view.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

import trackfeatures as tf
from mtlnet.data.custom_images import CustomImages
from mtlnet.data.labels_file import LabelledPicture
from mtlnet.data.picture_copies import COPIES
from mtlnet.evaluation.metrics import coverage, evaluate_outputs, signed_errors
from mtlnet.inference.out_of_distribution import is_out_of_distribution
from mtlnet.inference.prediction import split_outputs

FEATURES = ("ml", "mr", "lane_width", "to_lane_centre", "angle")
GROUPS = {"by_drive": "drive", "by_light": "light", "by_copy": "copy", "by_training": "training"}
TRAINED, NOT_TRAINED = "trained on", "not trained on"
UNNAMED = "not given"


@dataclass(frozen=True)
class Answers:
    """A model's answers for N labelled pictures."""

    images: CustomImages
    outputs: NDArray[np.float32]
    """Outputs (N, K; columns: `split_outputs`) in metres at the pictures' own cameras."""
    true: NDArray[np.float64]
    """Labels (N, 5) in the order of `FEATURES`, NaN where absent or unknown."""
    found: NDArray[np.float64]
    """The model's answers (N, 5) in the order of `FEATURES`, NaN where absent."""
    trained: frozenset[str]
    """SHA-256 of the picture files that the model was trained on."""

    @cached_property
    def trained_files(self) -> frozenset[str]:
        """Names of the labelled files that the model was trained on."""
        pairs = zip(self.images.pictures, self.images.hashes, strict=True)
        return frozenset(picture.file for picture, found in pairs if found in self.trained)

    @property
    def errors(self) -> NDArray[np.float64]:
        """Errors (N, 5), answer minus label, in the order of `FEATURES`, m and rad; NaN where
        either has no value."""
        return self.found - self.true

    @property
    def absent(self) -> NDArray[np.bool_]:
        """Mask (N,) of the pictures whose lane is labelled but answered as absent."""
        return np.isfinite(self.true[:, 0]) & np.isnan(self.found[:, 0])

    @property
    def foreign(self) -> NDArray[np.bool_] | None:
        """Mask (N,) of the pictures that the model flags as out of distribution; None for a model
        without this flag."""
        score = split_outputs(self.outputs).ood_score
        return None if score is None else is_out_of_distribution(score)

    @property
    def label_std(self) -> NDArray[np.float64]:
        """Standard deviations of the labels (N, 7), m and rad, in the order of
        `mtlnet.inference.prediction.FEATURES`."""
        stds = [[p.std_m] * 6 + [p.std_rad] for p in self.images.pictures]
        return np.array(stds, np.float64)


def judge(
    images: CustomImages, outputs: NDArray[np.float32], trained: Sequence[str] = ()
) -> Answers:
    """Convert the model's outputs (N, K; columns: `split_outputs`) for the rectified images to
    answers at the pictures' own cameras. `trained`: SHA-256 of the picture files that the model was
    trained on."""
    outputs = images.outputs(outputs)
    distances, angle = tf.decode(outputs[:, :6])
    labels = images.labels
    return Answers(
        images,
        outputs,
        _features(labels.distances, labels.angle),
        _features(distances, angle),
        frozenset(trained),
    )


def _features(distances: NDArray[Any], angle: NDArray[Any]) -> NDArray[np.float64]:
    """Return the values (N, 5) of `FEATURES`, NaN where absent or unknown, from distances (N, 5)
    and angles (N,)."""
    known = np.where(np.isinf(distances), np.nan, distances).astype(np.float64)
    offset = tf.localise(distances)
    offset = np.where(np.isinf(offset), np.nan, offset)
    return np.column_stack([known[:, 0], known[:, 1], known[:, 1] - known[:, 0], offset, angle])


def picture_report(answers: Answers, mean: dict[str, Any]) -> dict[str, Any]:
    """Return the report of `evaluate_outputs` with the further key `pictures`, whose value has
    counts and errors for all pictures and by group (`part_report`).

    `mean`: the means of the training labels, which are the baseline's prediction.
    """
    labels = answers.images.labels
    report = evaluate_outputs(answers.outputs, labels, mean)
    if "uncertainty" in report:
        report["uncertainty"]["coverage"] = _coverage(answers, slice(None))
    everything = part_report(answers, lambda picture, copy: True)
    groups = {name: dict(_groups(answers, name)) for name in GROUPS}
    # A grouping without information is left out of the report.
    groups = {k: v for k, v in groups.items() if [*v] not in ([UNNAMED], [NOT_TRAINED])}
    label_std = answers.label_std
    about = {
        "files": len({p.file for p in _pictures(answers)}),
        "label_std": {
            "m": float(label_std[:, 0].mean()),
            "rad": float(label_std[:, -1].mean()),
        },
    }
    return {**report, "pictures": {**about, **everything, **groups}}


def _pictures(answers: Answers) -> list[LabelledPicture]:
    return [*answers.images.pictures, *(picture for picture, _, _ in answers.images.refused)]


def group_of(answers: Answers, name: str, picture: LabelledPicture, copy: str) -> str:
    """Return the name of the group to which a picture belongs in the grouping `name`, a key of
    `GROUPS`. `copy`: kind of copy, one of `mtlnet.data.picture_copies.COPIES`."""
    if name == "by_copy":
        return copy
    if name == "by_training":
        return TRAINED if picture.file in answers.trained_files else NOT_TRAINED
    return (picture.drive if name == "by_drive" else picture.light) or UNNAMED


def _groups(answers: Answers, name: str) -> Iterator[tuple[str, dict[str, Any]]]:
    images = answers.images
    cases = [*zip(images.pictures, images.copies, strict=True), *(r[:2] for r in images.refused)]
    of_case = {
        (picture.file, copy): group_of(answers, name, picture, copy) for picture, copy in cases
    }
    names = sorted({*of_case.values()})
    if name == "by_copy":
        names.sort(key=COPIES.index)
    for group in names:

        def within(picture: LabelledPicture, copy: str, group: str = group) -> bool:
            return of_case[picture.file, copy] == group

        yield group, part_report(answers, within)


def part_report(answers: Answers, chosen: Callable[[LabelledPicture, str], bool]) -> dict[str, Any]:
    """Return counts and errors of the pictures and copies for which `chosen(picture, copy)` is
    true.

    `mean`, `median`: mean and median of the absolute errors; `mean_of_drives`: the mean of the
    drives' means; `always_median`: the mean error of always answering the median of the chosen
    labels; `within_std`: the share of errors within one standard deviation, whose square is the sum
    of the predicted variance and the label's variance.
    """
    images = answers.images
    pairs = zip(images.pictures, images.copies, strict=True)
    rows = np.array([i for i, pair in enumerate(pairs) if chosen(*pair)], np.int64)
    refused = sum(chosen(picture, copy) for picture, copy, _ in images.refused)
    sizes = np.abs(answers.errors[rows])
    drives = np.array([images.pictures[i].drive for i in rows])
    true = answers.true[rows]
    foreign = answers.foreign
    part = {
        "cases": len(rows) + refused,
        "refused": refused,
        "absent": int(answers.absent[rows].sum()),
        "out_of_distribution": None if foreign is None else int(foreign[rows].sum()),
        "mean": _named(_over(np.mean, sizes)),
        "median": _named(_over(np.median, sizes)),
        "mean_of_drives": _named(_mean_of_drives(sizes, drives)),
        "always_median": _named(_over(np.mean, np.abs(true - _over(np.median, true)))),
    }
    if split_outputs(answers.outputs).std is not None:
        part["within_std"] = {k: v[0] for k, v in _coverage(answers, rows).items()}
    return part


def _coverage(answers: Answers, rows: Any) -> dict[str, list[float | None]]:
    """Return, for each feature by name, the shares of errors within one and two standard
    deviations. The variance is the sum of the predicted variance and the label's variance."""
    labels = answers.images.labels.take(rows)
    outputs = answers.outputs[rows]
    std = split_outputs(outputs).std
    assert std is not None
    errors = signed_errors(outputs, labels.distances, labels.angle)
    return coverage(np.hypot(std, answers.label_std[rows]), errors)


def _over(statistic: Callable[[Any], Any], values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return `statistic` of each column's values that are not NaN; NaN for an empty column."""
    columns = (column[~np.isnan(column)] for column in values.T)
    return np.array([statistic(c) if len(c) else np.nan for c in columns], np.float64)


def _mean_of_drives(sizes: NDArray[np.float64], drives: NDArray[np.str_]) -> NDArray[np.float64]:
    means = [_over(np.mean, sizes[drives == drive]) for drive in np.unique(drives)]
    return _over(np.mean, np.array(means).reshape(-1, len(FEATURES)))


def _named(values: NDArray[np.float64]) -> dict[str, float | None]:
    return {
        name: None if np.isnan(value) else float(value)
        for name, value in zip(FEATURES, values, strict=True)
    }
