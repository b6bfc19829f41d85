"""The statistics page of a dataset (HTML): distributions, balance, warnings, sample frames."""

from collections.abc import Iterable, Iterator
from typing import Any

import numpy as np
from markupsafe import Markup

import trackfeatures as tf
from datagen.recording.dataset import Dataset
from datagen.recording.labels import Labels
from datagen.recording.names import SIDES
from datagen.recording.round_metadata import RoundInfo
from datagen.recording.statistics import describe
from datagen.stats.contact_sheet import contact_sheet
from runtime.html import embed_jpeg, render
from runtime.svg_charts import bars, histogram

BALANCED_BY = ("track", "lanes", "trajectory", "traffic")
"""Properties of a round; the page has a bar chart of the frames by each of them."""
MIN_CLASS_SHARE = 0.15
MIN_ACTIVE_SHARE = 0.02
SHARED_BY_SPLITS = ("track", "lanes", "light", "trajectory")
"""Properties of a round. Each of their values should occur on both sides, train and test."""
REQUIRED_SPLITS = ("train", "test")
"""Sides of the split that every dataset needs. The side `unseen` is recorded only on request, on
other tracks."""


def page(dataset: Dataset) -> str:
    """Return the HTML of the page, which needs no other file."""
    statistics = describe(dataset)
    labels = dataset.select("all").labels
    splits = np.array([info.split for info in dataset.rounds])[labels.round]
    shown = [split for split in SIDES if split in splits or split in REQUIRED_SPLITS]
    by_split = {split: labels.take(np.flatnonzero(splits == split)) for split in shown}
    return render(
        "datagen.stats",
        "page.html",
        name=dataset.path.resolve().name,
        statistics=statistics,
        concerns=concerns(statistics, dataset.rounds),
        balance=_balance(dataset, by_split),
        histograms=_histograms(by_split),
        cards=(
            {"jpeg": embed_jpeg(card.image), "about": card.about, "caption": card.caption}
            for card in contact_sheet(dataset)
        ),
    )


def _balance(dataset: Dataset, by_split: dict[str, Labels]) -> Iterator[Markup]:
    counts = [np.bincount(labels.heading, minlength=3).tolist() for labels in by_split.values()]
    yield bars(
        "heading class",
        {kind.name.lower(): [count[kind] for count in counts] for kind in tf.RoadClass},
    )
    splits = list(by_split)
    for name in BALANCED_BY:
        frames: dict[str, list[int]] = {}
        for info in dataset.rounds:
            row = frames.setdefault(info.values_of(name)[0], [0] * len(splits))
            if info.split in splits:
                row[splits.index(info.split)] += info.frames
        yield bars(name, dict(sorted(frames.items(), key=_numbers_in_order)))
    lights = sorted({light for labels in by_split.values() for light in labels.light.tolist()})
    yield bars(
        "light",
        {k: [int((labels.light == k).sum()) for labels in by_split.values()] for k in lights},
    )


def _numbers_in_order(item: tuple[str, Any]) -> tuple[int, str]:
    return (int(item[0]) if item[0].isdigit() else 0, item[0])


def _histograms(by_split: dict[str, Labels]) -> Iterator[Markup]:
    for i, marking in enumerate(tf.MARKINGS):
        columns = {split: labels.distances[:, i] for split, labels in by_split.items()}
        yield histogram(marking, "m", columns)
    for name, unit, scale in (
        ("to_lane_centre", "m", 1.0),
        ("to_middle", "m", 1.0),
        ("angle", "rad", 1.0),
        ("curvature", "1/m", 1.0),
        ("speed", "km/h", 3.6),
        ("shadow_fraction", "of the road within 30 m", 1.0),
    ):
        columns = {split: getattr(labels, name) * scale for split, labels in by_split.items()}
        yield histogram(name.replace("_", " "), unit, columns)


# Concerns: properties of a dataset that would make a model worse.


def concerns(statistics: dict[str, Any], rounds: Iterable[RoundInfo]) -> list[str]:
    """Return warnings about the dataset, one sentence each. `statistics` is the result of
    `datagen.recording.statistics.describe`."""
    return [
        *_empty_splits(statistics),
        *_rare_labels(statistics),
        *_one_sided_properties(list(rounds)),
    ]


def _empty_splits(statistics: dict[str, Any]) -> Iterator[str]:
    for split in REQUIRED_SPLITS:
        if not statistics[split]["frames"]:
            yield f"No round is for {split}: collect more rounds or make another split."


def _rare_labels(statistics: dict[str, Any]) -> Iterator[str]:
    for split in REQUIRED_SPLITS:
        if not statistics[split]["frames"]:
            continue
        for name, share in statistics[split]["heading"].items():
            if share < MIN_CLASS_SHARE:
                yield (
                    f"Class {name} has {share:.1%} of the {split} frames, less than "
                    f"{MIN_CLASS_SHARE:.0%}: a model may learn to ignore it."
                )
        for name, share in statistics[split]["active"].items():
            if share < MIN_ACTIVE_SHARE:
                yield (
                    f"{name} is active in {share:.1%} of the {split} frames: too few to evaluate "
                    "a model on."
                )


def _one_sided_properties(rounds: list[RoundInfo]) -> Iterator[str]:
    """Yield a warning for each property with values that occur only in train or only in test."""
    by_split = {s: [info for info in rounds if info.split == s] for s in REQUIRED_SPLITS}
    if not all(by_split.values()):
        return
    for name in SHARED_BY_SPLITS:
        train, test = ({v for i in by_split[s] for v in i.values_of(name)} for s in REQUIRED_SPLITS)
        for only, other, split in (
            (train - test, "test", "train"),
            (test - train, "train", "test"),
        ):
            if only:
                values = ", ".join(sorted(only))
                yield f"{name.capitalize()} {values}: in {split} rounds only, in no {other} round."
