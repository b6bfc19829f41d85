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
from numpy.typing import NDArray

from controllers.demo.frames import Asked
from controllers.demo.picture import draw_answer
from controllers.demo.run import DemoConfig, DemoResult
from datagen.recording import Dataset
from mtlnet.curves import read_curves
from simulator.car import CarParameters
from trackfeatures import MARKINGS

LIMITS = {"ml": 0.35, "mr": 0.35, "angle": 0.03, "heading": 0.85}
"""What the demo must reach: mean error in m and rad, and the share of right classes."""
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
            pictures=_pictures(config, result.asked),
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
    limit: float
    mean: float
    reached: bool


def verdicts(evaluation: dict[str, Any]) -> list[Verdict]:
    """What the model reached, feature by feature."""
    baseline = evaluation["baseline"]
    rows = []
    for name in MARKINGS:
        error, mean = evaluation["mae_m"][name], baseline["mae_m"][name]
        if error is None or mean is None:  # a marking no test frame shows, as on one-lane roads
            continue
        rows.append(_verdict(f"{name} (m)", error, LIMITS.get(name, np.inf), mean))
    angle, mean_angle = evaluation["angle_mae_rad"], baseline["angle_mae_rad"]
    rows.append(_verdict("angle (rad)", angle, LIMITS["angle"], mean_angle))
    right, most_frequent = evaluation["heading_accuracy"], baseline["heading_accuracy"]
    limit = LIMITS["heading"]
    rows.append(Verdict("heading (share right)", right, limit, most_frequent, right >= limit))
    return rows


def _verdict(what: str, error: float, limit: float, mean: float) -> Verdict:
    return Verdict(what, error, limit, mean, error <= limit and error <= LEARNED_RATIO * mean)


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
    rows = [
        (
            one.what,
            f"{one.figure:.4f}",
            "" if np.isinf(one.limit) else f"{one.limit:g}",
            f"{one.mean:.4f}",
            f"{one.figure / one.mean:.2f}",
            "yes" if one.reached else "NO",
        )
        for one in verdicts(evaluation)
    ]
    head = ("feature", "mean error", "limit", "always the mean", "ratio", "reached")
    return _table(head, rows)


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


def _pictures(config: DemoConfig, asked: list[Asked]) -> str:
    dataset = Dataset.open(config.out / "data")
    frames, camera = dataset.select("test"), dataset.camera
    images = np.empty((len(asked), camera.height, camera.width, 3), np.uint8)
    frames.read_batch(np.array([one.index for one in asked]), images)
    height_m = camera.z + CarParameters().cg_height
    figures = []
    for one, image in zip(asked, images, strict=True):
        answer = (one.answer["distances_m"], one.answer["angle_rad"])
        drawn = draw_answer(
            image, camera, height_m, one.curvature, (one.distances, one.angle), answer
        )
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
