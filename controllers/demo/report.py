"""The demo's HTML report: one self-contained page with figures, curves and pictures."""

import base64
import html
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from string import Template
from typing import Any

import cv2
import numpy as np
import simplejpeg
from numpy.typing import NDArray

from controllers.config import DemoConfig
from controllers.demo.frames import Asked
from controllers.demo.run import DemoResult
from datagen.recording import Dataset
from mtlnet.inference.curves import read_curves
from mtlnet.inference.overlay import draw_overlay
from simulator.vehicle.car import CarParameters
from trackfeatures import MARKINGS
from trackfeatures.camera import CameraParameters

LIMITS = {"ml": 0.35, "mr": 0.35, "angle": 0.03, "heading": 0.85}
"""What the demo must reach: mean error in m and rad, and the share of right classes."""
VERDICT_COLUMNS = ("feature", "mean error", "limit", "always the mean", "ratio", "reached")
LEARNED_RATIO = 0.65
"""Learned, not guessed: at most this share of the error of always answering the training mean."""


def write_report(config: DemoConfig, result: DemoResult) -> Path:
    """Write `report.html` into the demo's folder; gives its path."""
    page = Template((Path(__file__).parent / "report.html").read_text())
    path = config.out / "report.html"
    path.write_text(
        page.substitute(
            summary=_summary(config, result),
            accuracy=_accuracy(result.evaluation),
            curves=_curves(config.out / "run" / "curves.csv"),
            pictures=_pictures(Dataset.open(config.out / "data").camera, result.asked),
            answers=_answers(result.asked),
            drive=_drive(result.drive),
            commands=html.escape("\n".join(result.commands)),
        )
    )
    return path


@dataclass(frozen=True, slots=True)
class Verdict:
    """One figure of the evaluation beside its limit and that of always answering the mean."""

    what: str
    figure: float
    mean: float
    limit: float | None = None
    """None: the demo sets none for it."""
    reached: bool = True

    @property
    def word(self) -> str:
        if self.limit is None:
            return ""
        return "yes" if self.reached else "NO"


def verdicts(evaluation: dict[str, Any]) -> list[Verdict]:
    """What the model reached, feature by feature."""
    baseline = evaluation["baseline"]
    rows = []
    for name in MARKINGS:
        error, mean = evaluation["mae_m"][name], baseline["mae_m"][name]
        if error is not None and mean is not None:  # on one lane, no test frame may show an `l`
            rows.append(_error_verdict(f"{name} (m)", error, mean, LIMITS.get(name)))
    angle, mean_angle = evaluation["angle_mae_rad"], baseline["angle_mae_rad"]
    rows.append(_error_verdict("angle (rad)", angle, mean_angle, LIMITS["angle"]))
    right, most_frequent = evaluation["heading_accuracy"], baseline["heading_accuracy"]
    least = LIMITS["heading"]
    rows.append(Verdict("heading (share right)", right, most_frequent, least, right >= least))
    return rows


def _error_verdict(what: str, error: float, mean: float, limit: float | None) -> Verdict:
    reached = limit is None or (error <= limit and error <= LEARNED_RATIO * mean)
    return Verdict(what, error, mean, limit, reached)


def _summary(config: DemoConfig, result: DemoResult) -> str:
    collected = result.collected
    steps = ", ".join(f"{name} {seconds:.0f} s" for name, seconds in result.seconds.items())
    return (
        f"{collected['frames']} frames in {collected['rounds']} rounds at "
        f"{collected['frames_per_second']:.0f} frames a second; "
        f"trained {config.minutes:g} minutes with alpha {html.escape(config.alpha)}; "
        f"{result.evaluation['frames']} frames of unseen rounds judge it. Time: {steps}."
    )


def _accuracy(evaluation: dict[str, Any]) -> str:
    rows = [verdict_cells(one) for one in verdicts(evaluation)]
    return _table(VERDICT_COLUMNS, rows)


def verdict_cells(one: Verdict) -> tuple[str, ...]:
    """A verdict as the cells of `VERDICT_COLUMNS`."""
    limit = "" if one.limit is None else f"{one.limit:g}"
    ratio = f"{one.figure / one.mean:.2f}"
    return one.what, f"{one.figure:.4f}", limit, f"{one.mean:.4f}", ratio, one.word


def _answers(asked: list[Asked]) -> str:
    head = ("round", "track", "lanes", *(f"{name} (m)" for name in MARKINGS))
    head += ("to lane centre (m)", "angle (rad)", "heading")
    rows = []
    for one in asked:
        found = one.answer["distances_m"]
        centre = one.answer["to_lane_centre_m"]
        rows.append(
            (
                one.round_id,
                one.track,
                str(one.lanes),
                *(_pair(one.distances[name], found[name], 2) for name in MARKINGS),
                _pair(one.to_lane_centre, centre, 2),
                _pair(one.angle, one.answer["angle_rad"], 3),
                f"{one.heading} / {one.answered_heading}",
            )
        )
    return _table(head, rows)


def _pair(true: float | None, answered: float | None, digits: int) -> str:
    return " / ".join("absent" if v is None else f"{v:+.{digits}f}" for v in (true, answered))


def _pictures(camera: CameraParameters, asked: list[Asked]) -> str:
    height_m = camera.z + CarParameters().cg_height
    figures = []
    for one in asked:
        frame = simplejpeg.decode_jpeg(one.jpeg)
        answer = (one.answer["distances_m"], one.answer["angle_rad"])
        truth = (one.distances, one.angle)
        drawn = draw_overlay(frame, camera, height_m, one.curvature, truth, answer)
        caption = html.escape(
            f"{one.track}, {one.lanes} lane{'s'[: one.lanes > 1]}, {one.round_id}"
        )
        figures.append(f'<figure><img src="{_data_uri(drawn)}"><figcaption>{caption}</figure>')
    return "".join(figures)


def _data_uri(image: NDArray[np.uint8]) -> str:
    _, encoded = cv2.imencode(".jpg", cv2.cvtColor(image, cv2.COLOR_RGB2BGR))
    return "data:image/jpeg;base64," + base64.b64encode(encoded.tobytes()).decode()


def _curves(path: Path) -> str:
    """The training losses as SVG lines, each scaled to its own first value."""
    rows = read_curves(path)
    if not rows:
        return "<p>The training was too short for a curve.</p>"
    steps = [row["step"] for row in rows]
    lines, legend = [], []
    for task, colour in (("distance", "#2b6"), ("angle", "#e82"), ("type", "#36c")):
        loss = [row[f"{task}_loss"] for row in rows]
        points = " ".join(
            f"{600 * step / steps[-1]:.1f},{180 - 170 * min(value / loss[0], 1.0):.1f}"
            for step, value in zip(steps, loss, strict=True)
        )
        lines.append(f'<polyline stroke="{colour}" points="{points}"/>')
        legend.append(f'<b style="color:{colour}">{task}</b> {loss[0]:.3g} to {loss[-1]:.3g}')
    svg = f'<svg viewBox="0 0 600 185" role="img" aria-label="losses">{"".join(lines)}</svg>'
    return f"{svg}<p>Losses over {steps[-1]:.0f} steps: {', '.join(legend)}.</p>"


def _drive(drive: dict[str, Any]) -> str:
    ended = drive["ended"] or "all its steps"
    return (
        f"The LQR controller, steered by the service's answers alone: {drive['steps']} steps of "
        f"50 ms, ended by {html.escape(str(ended))}, mean |d| {drive['mean_abs_d_m']:.2f} m, "
        f"largest {drive['max_abs_d_m']:.2f} m, {drive['score_per_step']:.3f} points a step."
    )


def _table(head: Iterable[str], rows: Iterable[Iterable[str]]) -> str:
    def line(tag: str, cells: Iterable[str]) -> str:
        return "<tr>" + "".join(f"<{tag}>{html.escape(c)}</{tag}>" for c in cells) + "</tr>"

    return "<table>" + line("th", head) + "".join(line("td", row) for row in rows) + "</table>"
