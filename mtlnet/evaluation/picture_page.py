"""Writes an evaluation on a user's own pictures as one HTML page: `mtlnet evaluate --data FOLDER
--report FILE`. Each picture shows its label (green) and the model's answer (orange); failures come
first."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

import trackfeatures as tf
from mtlnet.data.custom_images import CustomImages
from mtlnet.data.labels_file import LabelledPicture
from mtlnet.data.picture_copies import copied_camera, copied_picture
from mtlnet.evaluation.pictures import FEATURES, GROUPS, Answers
from mtlnet.inference.image_decoding.decode import read_whole_image
from mtlnet.inference.overlay import (
    PREDICTION_COLOUR,
    TRUTH_COLOUR,
    draw_road_line,
    marking_line,
)
from mtlnet.inference.prediction import FEATURES as ANSWERS
from mtlnet.inference.prediction import split_outputs
from runtime.files import atomic_write, name_as_text
from runtime.html import embed_jpeg, format_number, format_percent, render
from trackfeatures.camera import CameraParameters

WIDTH_PX = 400
ALONG_M = np.geomspace(2.0, 35.0, 40)
"""Positions along the road, m, between which markings are drawn."""
TITLES = {
    "ml": "left (m)",
    "mr": "right (m)",
    "lane_width": "lane width (m)",
    "to_lane_centre": "centre (m)",
    "angle": "heading (rad)",
}
DIGITS = {name: 4 if name == "angle" else 3 for name in FEATURES}

Rows = list[list[str]]
Image = NDArray[np.uint8]


@dataclass(frozen=True)
class Case:
    """A picture or copy on the page. `row`: its index in the answers; None if the picture was
    refused."""

    picture: LabelledPicture
    copy: str
    row: int | None
    verdict: str
    """A text about the failure or refusal; empty if there is none."""


def write_picture_page(path: Path, report: dict[str, Any], answers: Answers) -> Path:
    """Write the page of a report of `mtlnet.evaluation.pictures.picture_report` to `path`; returns
    `path`."""
    figures = report["pictures"]
    page = render(
        "mtlnet.evaluation",
        "pictures.html",
        report=report,
        figures=figures,
        error_head=["", *TITLES.values()],
        error_rows=list(_error_rows(figures)),
        share_rows=_share_rows(figures),
        within_rows=list(_within_rows(figures)),
        groups=list(_groups(figures)),
        cases=[_figure(answers, case) for case in cases(answers)],
    )
    atomic_write(path, page, fsync=True)
    return path


def _error_rows(figures: dict[str, Any]) -> Iterator[list[str]]:
    for title, key in (
        ("mean", "mean"),
        ("median", "median"),
        ("mean of the drives' means", "mean_of_drives"),
        ("always answering the labels' median", "always_median"),
    ):
        yield [title, *_cells(figures[key])]
    std = figures["label_std"]
    lengths = [format_number(std["m"], 3)] * 2 + ["-"] + [format_number(std["m"], 3)]
    yield ["the labels' own standard deviation", *lengths, format_number(std["rad"], 4)]


def _cells(values: dict[str, float | None]) -> list[str]:
    return [format_number(values[name], DIGITS[name]) for name in FEATURES]


def _share_rows(figures: dict[str, Any]) -> Rows:
    names = {
        "refused": "refused: it shows too little of the model's view",
        "absent": "answered absent: the lane is labelled",
        "out_of_distribution": "called out of distribution",
    }
    return [
        [title, f"{figures[key]}", format_percent(figures[key] / figures["cases"])]
        for key, title in names.items()
        if figures[key] is not None
    ]


def _within_rows(figures: dict[str, Any]) -> Iterator[list[str]]:
    for name, share in figures.get("within_std", {}).items():
        if share is not None:
            yield [name, format_percent(share)]


def _groups(figures: dict[str, Any]) -> Iterator[dict[str, Any]]:
    for grouping, label in GROUPS.items():
        if grouping not in figures:
            continue
        head = [label, "pictures", "refused", "absent", "out of distr.", *TITLES.values()]
        rows = []
        for name, part in figures[grouping].items():
            counts = [part[key] for key in ("cases", "refused", "absent", "out_of_distribution")]
            texts = ["-" if count is None else f"{count}" for count in counts]
            rows.append([name, *texts, *_cells(part["mean"])])
        yield {"head": head, "rows": rows}


def cases(answers: Answers) -> list[Case]:
    """Return all pictures and copies, failures first.

    Refused pictures come first, then pictures whose lane is answered as absent, then all other
    pictures by their largest error. For this comparison an error is divided by the mean error of
    its feature.
    """
    images = answers.images
    sizes = np.abs(answers.errors)
    known = np.isfinite(sizes)
    sizes = np.where(known, sizes, 0.0)
    means = sizes.sum(0) / np.maximum(known.sum(0), 1)
    badness = (sizes / np.maximum(means, 1e-9)).max(1)
    foreign = answers.foreign
    found = [
        Case(picture, copy, None, f"refused: {reason}") for picture, copy, reason in images.refused
    ]
    order = np.lexsort([-badness, ~answers.absent])
    for row in order.tolist():
        words = ["answered absent"] if answers.absent[row] else []
        if foreign is not None and foreign[row]:
            words.append("out of distribution")
        picture, copy = images.pictures[row], images.copies[row]
        found.append(Case(picture, copy, row, ", ".join(words)))
    return found


def _figure(answers: Answers, case: Case) -> dict[str, Any]:
    """Return the figure of a case: the picture with label and answer drawn in, and its caption."""
    picture, row = case.picture, case.row
    place = ", ".join(text for text in (picture.drive, picture.light) if text)
    name = picture.file if case.copy == "plain" else f"{picture.file}, {case.copy}"
    texts: Rows = []
    if row is not None:
        std = split_outputs(answers.outputs[row]).std
        by_name = {} if std is None else dict(zip(ANSWERS, std.tolist(), strict=True))
        for i, feature in enumerate(FEATURES):
            true, found = answers.true[row, i], answers.found[row, i]
            numbers = ["-" if np.isnan(v) else f"{v:+.{DIGITS[feature]}f}" for v in (true, found)]
            error = found - true
            numbers.append("-" if np.isnan(error) else f"{error:+.{DIGITS[feature]}f}")
            numbers.append(format_number(by_name.get(feature), DIGITS[feature]))
            texts.append([TITLES[feature], *numbers])
    image = _drawn(answers, case)
    return {
        "jpeg": embed_jpeg(image),
        "name": name_as_text(name),
        "place": place,
        "verdict": case.verdict,
        "rows": texts,
    }


def _drawn(answers: Answers, case: Case) -> Image:
    """Return the picture or copy with label and answer drawn in, at most `WIDTH_PX` px wide."""
    images, picture = answers.images, case.picture
    whole = read_whole_image(images.path / picture.file)
    scale = min(1.0, WIDTH_PX / whole.shape[1])
    size = (round(whole.shape[1] * scale), round(whole.shape[0] * scale))
    small = cv2.resize(whole, size, interpolation=cv2.INTER_AREA).astype(np.uint8)
    row = case.row
    if row is None:
        return small
    camera = source_camera(images, row).resized(*size)
    taken = copied_camera(camera, case.copy)  # undoes the mirroring, or changes nothing
    canvas = copied_picture(small, taken, case.copy).copy()
    curvature = -picture.curvature if case.copy == "mirrored" else picture.curvature
    answered, angle = tf.decode(answers.outputs[row : row + 1, :6])
    labels = images.labels
    for distances, heading, colour, thickness in (
        (labels.distances[row], float(labels.angle[row]), TRUTH_COLOUR, 2),
        (answered[0], float(angle[0]), PREDICTION_COLOUR, 2),
    ):
        for distance in distances.tolist():
            if np.isfinite(distance):
                line = marking_line(distance, heading, curvature, ALONG_M)
                draw_road_line(canvas, camera, line, colour, thickness)
    return canvas


def source_camera(images: CustomImages, row: int) -> CameraParameters:
    """Return the camera of the picture or copy with the index `row`, with the size that its camera
    file states."""
    lens = images.lenses[row]
    return images.camera if lens is None else lens.source
