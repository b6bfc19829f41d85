"""Writes an evaluation as one self-contained HTML page: `mtlnet evaluate --report FILE`."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import simplejpeg
from markupsafe import Markup
from numpy.typing import NDArray

import trackfeatures as tf
from datagen.recording import Frames
from datagen.recording.names import PLACED
from mtlnet.data.model_labels import round_rectification
from mtlnet.evaluation.metrics import GROUPS, signed_errors
from mtlnet.evaluation.tables import error_cells, mean_error_cells
from mtlnet.inference.overlay import draw_overlay
from mtlnet.inference.prediction import FEATURES, Prediction, decode_outputs, split_outputs
from runtime.files import atomic_write
from runtime.html import embed_jpeg, format_percent, render
from runtime.svg_charts import MAX_POINTS, Line, Plot, line_plot, reliability_diagram, runs

FILE_NAME = "report.html"
MAX_ROUNDS = 8
"""Maximum number of rounds whose offset and angle are drawn along the track."""
HEAVY_SHADOW = 0.3
"""Intervals of a plot in which at least this share of the road is in shadow are shaded."""
UNITS = {name: "rad" if name == "angle" else "m" for name in FEATURES}
TITLES = {name: f"{name} ({unit})" for name, unit in UNITS.items()}

Rows = list[list[str]]


def page_file(path: Path) -> Path:
    """Return the file to which the page is written: `path`, or `report.html` in it if `path` is a
    folder. Makes the file's folder."""
    if path.is_dir():
        path = path / FILE_NAME
    path.parent.mkdir(parents=True, exist_ok=True)
    return path


def write_page(path: Path, report: dict[str, Any], frames: Frames, outputs: Any) -> Path:
    """Write the HTML page of `report`, the result of `mtlnet.evaluation.evaluate`, and return its
    file.

    `path`: a file or a folder; `outputs`: the model's outputs (N, K; columns: `split_outputs`) for
    `frames`.
    """
    path = page_file(path)
    atomic_write(path, page(report, frames, outputs), fsync=True)
    return path


def page(report: dict[str, Any], frames: Frames, outputs: NDArray[np.float32]) -> str:
    """Return the HTML page of `report`, with charts of offset and angle along the track, and the
    frames with the largest errors.

    `outputs`: the model's outputs (N, K; columns: `split_outputs`) for `frames`.
    """
    errors = signed_errors(outputs, frames.labels.distances, frames.labels.angle)
    return render(
        "mtlnet.evaluation",
        "report.html",
        report=report,
        error_rows=[
            [TITLES[name], *error_cells(report, name), f"{report['errors'][name]['frames']:,}"]
            for name in FEATURES
        ],
        confusion_head=["", *(f"predicted {name}" for name in report["confusion"])],
        confusion_rows=_confusion_rows(report["confusion"]),
        presence_rows=[
            [name, format_percent(rates["false_active"]), format_percent(rates["false_inactive"])]
            for name, rates in report["presence"].items()
        ],
        drives=_drives(frames, outputs),
        coverage_rows=[
            [name, *map(format_percent, shares)]
            for name, shares in report.get("uncertainty", {}).get("coverage", {}).items()
        ],
        reliability=_reliability(report.get("uncertainty", {})),
        worst=(
            {**figure, "jpeg": embed_jpeg(figure["image"])}
            for figure in worst_figures(frames, outputs, worst_frames(errors, frames.labels.round))
        ),
        groups=_groups(report),
    )


def _confusion_rows(confusion: dict[str, dict[str, int]]) -> Rows:
    rows = []
    for name, row in confusion.items():
        total = sum(row.values())
        shares = [f"{n:,} ({n / total:.1%})" if total else "-" for n in row.values()]
        rows.append([f"truly {name}", *shares])
    return rows


def _reliability(uncertainty: dict[str, Any]) -> Iterator[Markup]:
    for name, bins in uncertainty.get("calibration", {}).items():
        if bins:
            predicted = np.array([part["said"] for part in bins])
            observed = np.array([part["found"] for part in bins])
            yield reliability_diagram(TITLES[name], predicted, observed)


def _groups(report: dict[str, Any]) -> Iterator[dict[str, Any]]:
    """Yield a table for each grouping: mean errors by feature, and accuracy of the class."""
    for grouping, label in GROUPS.items():
        head = [label, "frames", *TITLES.values(), "class"]
        if "uncertainty" in report:
            head.append("out of distribution")
        rows = []
        for key, part in report[grouping].items():
            accuracy = format_percent(part["heading_accuracy"])
            row = [key, f"{part['frames']:,}", *mean_error_cells(part), accuracy]
            if "uncertainty" in report:
                row.append(format_percent(part["uncertainty"]["out_of_distribution"]))
            rows.append(row)
        yield {"head": head, "rows": rows}


# Offset and angle along the track, as in the paper's perception figure.


def _drives(frames: Frames, outputs: NDArray[np.float32]) -> Iterator[dict[str, Any]]:
    """Yield charts of the true and predicted offset and angle in the first drive on each track."""
    shown: set[str] = set()
    for number, info in enumerate(frames.rounds):
        rows = np.flatnonzero(frames.labels.round == number)
        if info.track in shown or len(shown) == MAX_ROUNDS or not len(rows):
            continue
        if info.trajectory == PLACED:
            continue  # its frames are no drive
        shown.add(info.track)
        yield {
            "about": f"{info.track}, {info.lanes} lane(s), {info.light} ({info.id})",
            "charts": _drive_charts(frames, rows, outputs[rows]),
        }


def _drive_charts(
    frames: Frames, rows: NDArray[np.int64], outputs: NDArray[np.float32]
) -> Iterator[Markup]:
    labels = frames.labels.take(rows)
    metres = _distance_driven(labels.s.astype(np.float64))
    offset = tf.localise(tf.decode(outputs[:, :6])[0])
    angle, std = tf.decode_values(outputs[:, :6])[:, 5], split_outputs(outputs).std
    thinned = slice(None, None, -(-len(rows) // MAX_POINTS))
    last = len(rows) - 1
    shaded = [
        (float(metres[run.start]), float(metres[min(run.stop, last)]))
        for run in runs(labels.shadow_fraction >= HEAVY_SHADOW)
    ]
    for title, unit, true, predicted, column in (
        ("offset from the lane centre", "m", tf.localise(labels.distances), offset, -2),
        ("angle", "rad", labels.angle.astype(np.float64), angle, -1),
    ):
        band = None
        if std is not None:
            width = 2 * std[:, column].astype(np.float64)
            band = (predicted - width)[thinned], (predicted + width)[thinned]
        x = metres[thinned]
        lines = [
            Line("truth", x, true[thinned]),
            Line("predicted", x, predicted[thinned], band=band),
        ]
        yield line_plot(Plot(f"{title} ({unit})", lines, "m driven", shaded))


def _distance_driven(s: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the distance driven (N,) since the first frame, m, from the track positions s (N,), m.
    The step across the start line, where s jumps back, counts as 0."""
    steps = np.diff(s)
    steps[steps < 0] = 0.0
    return np.concatenate([[0.0], np.cumsum(steps)])


# The frames with the largest errors, with true and predicted markings drawn on them.


WORST_PER_FEATURE = 2
MIN_FRAMES_APART = 40
"""Least number of frames between two worst frames of a round, so that each part of the road is
shown once."""


@dataclass(frozen=True)
class WorstFrame:
    """The frame with the index `row`, in which the error of `feature` is large. `error`: this error
    with its sign, m or rad."""

    row: int
    feature: str
    error: float


def worst_frames(errors: NDArray[np.float64], rounds: NDArray[np.int64]) -> list[WorstFrame]:
    """Return the two frames with the largest errors of each feature. Frames of one round are at
    least 40 frames apart, so that they show different parts of the road.

    `errors` (N, 7) in the order of `FEATURES`, NaN where not evaluated; `rounds` (N,): index of
    each frame's round.
    """
    chosen: list[WorstFrame] = []
    for i in (5, 6, 0, 1, 3, 2, 4):
        sizes = np.abs(errors[:, i])
        order = np.argsort(-np.nan_to_num(sizes, nan=-1.0), kind="stable")
        found = 0
        for row in order.tolist():
            if found == WORST_PER_FEATURE or np.isnan(sizes[row]):
                break
            if all(
                abs(row - w.row) >= MIN_FRAMES_APART or rounds[row] != rounds[w.row] for w in chosen
            ):
                chosen.append(WorstFrame(row, FEATURES[i], float(errors[row, i])))
                found += 1
    return chosen


def worst_figures(
    frames: Frames, outputs: NDArray[np.float32], chosen: list[WorstFrame]
) -> Iterator[dict[str, Any]]:
    """Yield for each frame in `chosen` its image, with true markings in green and predicted
    markings in orange, and its caption. `outputs` (N, K; columns: `split_outputs`) are the outputs
    for all `frames`.

    The keys are `image`, RGB at twice the frame's size beside a view from above, and the texts
    `feature`, `error`, `note` and `place`.
    """
    labels = frames.labels
    for worst in chosen:
        row = worst.row
        prediction = decode_outputs(outputs[row])
        truth = [None if np.isnan(d) else float(d) for d in labels.distances[row]]
        info = frames.rounds[labels.round[row]]
        view = round_rectification(info, frames.camera).view
        image = draw_overlay(
            frames.image(row),
            view,
            float(labels.curvature[row]),
            (dict(zip(tf.MARKINGS, truth, strict=True)), float(labels.angle[row])),
            (prediction.distances_m, prediction.angle_rad),
        )
        yield {"image": image, **_caption(frames, worst, prediction)}


def _caption(frames: Frames, worst: WorstFrame, prediction: Prediction) -> dict[str, str]:
    labels, unit = frames.labels, UNITS[worst.feature]
    info = frames.rounds[int(labels.round[worst.row])]
    note = ""
    if prediction.std is not None:
        std = prediction.std[worst.feature]
        if std is None:  # predicted absent; the error is the error of the undecoded value
            note = ", predicted absent"
        else:
            note = f", predicted standard deviation {std:.2g} {unit}"
    if prediction.out_of_distribution:
        note += ", out of distribution"
    return {
        "feature": worst.feature,
        "error": f"{worst.error:+.2g} {unit}",
        "note": note,
        "place": f"{info.id}, {info.track}, s = {labels.s[worst.row]:.0f} m; {info.lanes} lane(s), "
        f"{labels.light[worst.row]}, {labels.speed[worst.row] * 3.6:.0f} km/h",
    }


SHEET_COLUMNS = 4
CAPTION_PX = 48


def write_worst_sheet(path: Path, frames: Frames, outputs: NDArray[np.float32]) -> Path:
    """Write the frames with the largest errors of each feature as one JPEG with captions; returns
    `path`. `outputs`: the model's outputs (N, K; columns: `split_outputs`) for `frames`."""
    errors = signed_errors(outputs, frames.labels.distances, frames.labels.angle)
    figures = list(worst_figures(frames, outputs, worst_frames(errors, frames.labels.round)))
    height, width = frames.camera.height, frames.camera.width
    tile = height + CAPTION_PX
    shape = (-(-len(figures) // SHEET_COLUMNS) * tile, SHEET_COLUMNS * width, 3)
    sheet = np.full(shape, 255, np.uint8)
    for number, figure in enumerate(figures):
        top, left = number // SHEET_COLUMNS * tile, number % SHEET_COLUMNS * width
        road = figure["image"][:, : 2 * width]  # without the view from above
        image = cv2.resize(road, (width, height), interpolation=cv2.INTER_AREA)
        sheet[top : top + height, left : left + width] = image
        texts = (f"{figure['feature']} {figure['error']}", *figure["place"].split("; "))
        for line, text in enumerate(texts):
            place = (left + 3, top + height + 13 + 14 * line)
            cv2.putText(sheet, text, place, cv2.FONT_HERSHEY_SIMPLEX, 0.36, (0, 0, 0))
    atomic_write(path, simplejpeg.encode_jpeg(sheet, quality=80), fsync=True)
    return path
