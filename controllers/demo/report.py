"""Compares the demo's results with their limits, and writes them as tables for the terminal and as
an HTML report in one file."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import simplejpeg
from markupsafe import Markup
from rich.console import Console
from rich.table import Table

from controllers.demo.config import DemoConfig
from controllers.demo.frames import PostedFrame
from controllers.demo.run import DemoResult
from datagen.recording import Dataset
from mtlnet.inference.curves import read_curves
from mtlnet.inference.overlay import draw_overlay
from runtime.files import atomic_write
from runtime.html import embed_jpeg, render
from runtime.svg_charts import Line, Plot, line_plot
from trackfeatures import MARKINGS
from trackfeatures.camera import CameraParameters

LIMITS = {"ml": 0.35, "mr": 0.35, "angle": 0.03, "heading": 0.85}
"""Largest allowed mean errors of `ml` and `mr` (m) and of the angle (rad), and least allowed share
of right classes of the road."""
MAX_MEAN_ABS_D_M = 0.3
"""Largest allowed mean distance (m) from the centre of the lane in the drive on the service's
answers."""
LIMIT_COLUMNS = ("feature", "mean error", "limit", "training mean", "ratio", "reached")
LEARNED_RATIO = 0.65
"""A feature counts as learned if its error is at most this share of the baseline's error. The
baseline always predicts the mean of the training labels."""
MIN_TERMINAL_WIDTH = 120
"""Width of the tables in columns of the terminal. A narrower terminal wraps whole lines, which stay
readable."""
ANSWER_COLUMNS = (
    *("round", "track", "lanes"),
    *(f"{name} (m)" for name in MARKINGS),
    *("to lane centre (m)", "angle (rad)", "heading"),
)
CURVE_COLOURS = {"distance": "#22bb66", "angle": "#ee8822", "type": "#3366cc"}


@dataclass(frozen=True, slots=True)
class LimitCheck:
    """The comparison of one result of the demo with its limit and with the result of a baseline.

    The baseline always predicts the mean of the training labels, or the most frequent class.
    """

    what: str
    """Name of the result, with its unit."""
    figure: float
    """The result: an error or a share."""
    mean: float | None
    """The result of the baseline; None without a baseline."""
    limit: float | None = None
    """None if the demo sets no limit."""
    reached: bool = True
    """Whether the result meets its requirements: the limit; for the error of a feature with a limit
    also LEARNED_RATIO; for the drive also that it did not end early."""

    @property
    def word(self) -> str:
        if self.limit is None:
            return ""
        return "yes" if self.reached else "NO"


def check_limits(result: DemoResult) -> list[LimitCheck]:
    """Compare all results of the demo with their limits: the results of the evaluation, of the
    posted frames and of the drive."""
    return [
        *check_evaluation(result.evaluation),
        *check_posted(result.asked, result.evaluation),
        check_drive(result.drive),
    ]


def check_evaluation(evaluation: dict[str, Any]) -> list[LimitCheck]:
    """Compare each feature's error in an evaluation with its limit and with the error of a
    baseline.

    `evaluation` is the output of `mtlnet evaluate --json`. The baseline always predicts the mean of
    the training labels, or the most frequent class of the road.
    """
    baseline = evaluation["baseline"]
    rows = []
    for name in MARKINGS:
        error, mean = evaluation["mae_m"][name], baseline["mae_m"][name]
        if error is not None and mean is not None:  # test frames of one lane may show no `l`
            rows.append(_check_error(f"{name} (m)", error, mean, LIMITS.get(name)))
    angle, mean_angle = evaluation["angle_mae_rad"], baseline["angle_mae_rad"]
    rows.append(_check_error("angle (rad)", angle, mean_angle, LIMITS["angle"]))
    accuracy, most_frequent = evaluation["heading_accuracy"], baseline["heading_accuracy"]
    least = LIMITS["heading"]
    name = "heading (share right)"
    rows.append(LimitCheck(name, accuracy, most_frequent, least, accuracy >= least))
    return rows


def _check_error(what: str, error: float, mean: float, limit: float | None) -> LimitCheck:
    reached = limit is None or (error <= limit and error <= LEARNED_RATIO * mean)
    return LimitCheck(what, error, mean, limit, reached)


def check_posted(frames: list[PostedFrame], evaluation: dict[str, Any]) -> list[LimitCheck]:
    """Compare the service's mean errors of angle and offset over the posted `frames` with their
    limits.

    The limits are the 95th percentiles of the errors in `evaluation`, the output of `mtlnet
    evaluate --json`. If the service used another camera or model than the evaluation, its errors
    would exceed the limits by far.
    """
    found = []
    for what, name, pairs in (
        ("posted: angle (rad)", "angle", [(f.angle, f.answer["angle_rad"]) for f in frames]),
        (
            "posted: to lane centre (m)",
            "to_lane_centre",
            [(f.to_lane_centre, f.answer["to_lane_centre_m"]) for f in frames],
        ),
    ):
        errors = [abs(true - answer) for true, answer in pairs if None not in (true, answer)]
        limit = evaluation["errors"][name]["p95"]
        if errors and limit is not None:
            error = float(np.mean(errors))
            found.append(LimitCheck(what, error, None, limit, error <= limit))
    return found


def check_drive(drive: dict[str, Any]) -> LimitCheck:
    """Check the drive on the service's answers: the car must stay on the road, at a mean distance
    of at most 0.3 m from the centre of its lane.

    `drive` is the output of `controllers drive --json`.
    """
    mean = drive["mean_abs_d_m"]
    stayed = drive["ended"] is None and mean <= MAX_MEAN_ABS_D_M
    return LimitCheck("drive: mean |d| (m)", mean, None, MAX_MEAN_ABS_D_M, stayed)


def check_cells(check: LimitCheck) -> tuple[str, ...]:
    """Return the cells of the table row of `check`: the name, the result (usually a mean error),
    its limit, the result of the baseline, the ratio of the two results, and "yes" or "NO" for
    `check.reached`. A cell without a value is empty."""
    limit = "" if check.limit is None else f"{check.limit:.4g}"
    mean = "" if check.mean is None else f"{check.mean:.4f}"
    ratio = "" if check.mean is None else f"{check.figure / check.mean:.2f}"
    return check.what, f"{check.figure:.4f}", limit, mean, ratio, check.word


# The HTML report.


def write_report(config: DemoConfig, result: DemoResult) -> Path:
    """Write `report.html` into the demo's folder; returns its path."""
    path = config.out / "report.html"
    camera = Dataset.open(config.out / "data").camera
    page = render(
        "controllers.demo",
        "report.html",
        config=config,
        result=result,
        learned_ratio=LEARNED_RATIO,
        limit_columns=LIMIT_COLUMNS,
        limit_rows=[check_cells(one) for one in check_limits(result)],
        curves=_training_curves(config.out / "run" / "curves.csv"),
        shipped_figures=_figures(camera, result.shipped),
        figures=_figures(camera, result.asked),
        answer_columns=ANSWER_COLUMNS,
        answer_rows=[_answer_cells(one) for one in result.asked],
    )
    atomic_write(path, page)
    return path


def _answer_cells(frame: PostedFrame) -> tuple[str, ...]:
    """Return the cells of the table row of `frame`, "true / predicted" values. The columns are
    `ANSWER_COLUMNS`."""
    answer = frame.answer
    distances = ((frame.distances[name], answer["distances_m"][name]) for name in MARKINGS)
    return (
        frame.round_id,
        frame.track,
        str(frame.lanes),
        *(_pair(*values, 2) for values in distances),
        _pair(frame.to_lane_centre, answer["to_lane_centre_m"], 2),
        _pair(frame.angle, answer["angle_rad"], 3),
        f"{frame.heading} / {frame.answered_heading}",
    )


def _pair(true: float | None, predicted: float | None, digits: int) -> str:
    return " / ".join("inactive" if v is None else f"{v:+.{digits}f}" for v in (true, predicted))


def _figures(camera: CameraParameters, frames: list[PostedFrame]) -> Iterator[dict[str, str]]:
    """Yield the image of each frame, on which the true and the predicted markings are drawn, and
    its caption. `camera` is the camera of the frames."""
    for one in frames:
        image = simplejpeg.decode_jpeg(one.jpeg)
        prediction = (one.answer["distances_m"], one.answer["angle_rad"])
        truth = (one.distances, one.angle)
        drawn = draw_overlay(image, camera, one.curvature, truth, prediction)
        lanes = f"{one.lanes} lane{'s' if one.lanes > 1 else ''}"
        yield {"jpeg": embed_jpeg(drawn), "caption": f"{one.track}, {lanes}, {one.round_id}"}


def _training_curves(path: Path) -> Markup | None:
    """Return a chart of the losses over the training steps, read from the CSV file `path`. Each
    loss is divided by its first value. Returns None if the file has no row."""
    rows = read_curves(path)
    if not rows:
        return None
    steps = np.array([row["step"] for row in rows])
    lines = []
    for task, colour in CURVE_COLOURS.items():
        losses = np.array([row[f"{task}_loss"] for row in rows])
        label = f"{task} {losses[0]:.3g} to {losses[-1]:.3g}"
        lines.append(Line("curve", steps, np.minimum(losses / losses[0], 1.0), label, colour))
    return line_plot(Plot("losses, as a share of their first values", lines, "steps"))


# The tables for the terminal.


def print_tables(checks: list[LimitCheck], frames: list[PostedFrame]) -> None:
    """Print two tables on stdout: the comparison of the results with their limits, and the true and
    predicted values of `frames`."""
    console = Console()
    console = Console(width=max(console.width, MIN_TERMINAL_WIDTH))
    console.print(_limit_table(checks))
    console.print(_answers_table(frames))


def _limit_table(checks: list[LimitCheck]) -> Table:
    title = (
        f"Rounds of unseen seeds (learned: an error of at most {LEARNED_RATIO} of the training "
        "mean's)"
    )
    table = Table(title=title)
    for column in LIMIT_COLUMNS:
        table.add_column(column, justify="left" if column == "feature" else "right")
    for one in checks:
        table.add_row(*check_cells(one))
    return table


def _answers_table(frames: list[PostedFrame]) -> Table:
    table = Table(
        title="Held-out frames: true, predicted (centre: offset from the centre of the lane)"
    )
    columns = ("track", "lanes", "centre (m)", "ml (m)", "mr (m)", "m (m)", "angle (rad)")
    for column in (*columns, "heading"):
        table.add_column(column, no_wrap=True, justify="right")
    for one in frames:
        found = one.answer["distances_m"]
        table.add_row(
            one.track,
            str(one.lanes),
            _aligned_pair(one.to_lane_centre, one.answer["to_lane_centre_m"]),
            *(_aligned_pair(one.distances[name], found[name]) for name in ("ml", "mr", "m")),
            f"{one.angle:+.3f} {one.answer['angle_rad']:+.3f}",
            f"{one.heading} {one.answered_heading}",
        )
    return table


def _aligned_pair(true: float | None, predicted: float | None) -> str:
    return " ".join("  -  " if v is None else f"{v:+.2f}" for v in (true, predicted))
