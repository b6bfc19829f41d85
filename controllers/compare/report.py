"""The comparison as tables for the terminal, and as an HTML page with driving curves."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from markupsafe import Markup

from controllers.compare.run import REPORT
from controllers.drive.run import SCORED_STEPS
from runtime.files import atomic_write
from runtime.html import render
from runtime.svg_charts import Line, Plot, line_plot

PAPER_SCORES = {
    "forza": (6335.9, 6348.1, 6375.1),
    "alpine-2": (4400.1, 4411.6, 4419.4),
    "eroad": (3591.9, 3603.6, 3593.9),
    "g-track-3": (3209.4, 3210.5, 3215.3),
}
"""The best scores that the paper reports for its LQR, MPC and RL on each track, over the numbers of
steps in `SCORED_STEPS`."""
FIGURES = (
    "track", "controller", "score", "score per step", "quadratic per step", "mean |d| (m)",
    "max |d| (m)", "in the lane", "laps", "speed (km/h)", "blind steps", "ended",
)  # fmt: skip
TRUTH, PERCEIVED = "#2a9d5c", "#e07a2e"


def spread(values: list[float], digits: int) -> str:
    """Return the mean of `values` as text with `digits` decimals; the mean of several values is
    followed by their standard deviation ("0.99 ± 0.01")."""
    mean = f"{np.mean(values):.{digits}f}"
    return mean if len(values) == 1 else f"{mean} ± {np.std(values, ddof=1):.{digits}f}"


def score_table(drives: list[dict[str, Any]]) -> tuple[list[str], list[list[str]]]:
    """Return the column titles and the rows of a table of scores per step, with a row for each
    track and a column for each controller.

    `drives` are entries of `results.json` with the same perception and disturbance. If a track was
    driven over the paper's number of steps, the table also has the paper's scores.
    """
    controllers = list(dict.fromkeys(entry["controller"] for entry in drives))
    tracks = list(dict.fromkeys(entry["track"] for entry in drives))
    asked = {entry["track"]: entry["result"]["steps_asked"] for entry in drives}
    as_paper = [track for track in tracks if asked[track] == SCORED_STEPS.get(track)]
    rows = []
    for track in tracks:
        row = [f"{track} ({asked[track]} steps)"]
        for controller in controllers:
            found = _results(drives, track, controller)
            ended = sum(result["ended"] is not None for result in found)
            note = f" ({ended} ended early)" if ended else ""
            scores = [result["score_per_step"] for result in found]
            row.append(spread(scores, 4) + note if found else "-")
        if as_paper:
            shown = PAPER_SCORES[track] if track in as_paper else (None, None, None)
            row += ["-" if score is None else f"{score / asked[track]:.4f}" for score in shown]
        rows.append(row)
    paper = ["paper: LQR", "paper: MPC", "paper: RL"] if as_paper else []
    return ["track", *controllers, *paper], rows


def figure_rows(drives: list[dict[str, Any]]) -> Iterator[list[str]]:
    """Yield a table row for each track and controller in `drives`, entries of `results.json`.

    The titles of the columns are in FIGURES. Each cell combines the drives of all seeds: it
    contains their mean, an extreme value, or a range.
    """
    pairs = dict.fromkeys((entry["track"], entry["controller"]) for entry in drives)
    for track, controller in pairs:
        results = _results(drives, track, controller)
        slowest = min(result["speed_kmh"][0] for result in results)
        fastest = max(result["speed_kmh"][1] for result in results)
        ended = [result["ended"] for result in results if result["ended"] is not None]
        yield [
            track,
            controller,
            spread([result["score"] for result in results], 1),
            spread([result["score_per_step"] for result in results], 4),
            spread([result["quadratic_per_step"] for result in results], 5),
            spread([result["mean_abs_d_m"] for result in results], 3),
            f"{max(result['max_abs_d_m'] for result in results):.3f}",
            f"{min(result['in_lane_share'] for result in results):.2%}",
            f"{min(result['laps'] for result in results)}",
            f"{slowest:.0f} to {fastest:.0f}",
            f"{np.mean([result['blind_steps'] for result in results]):.0f}",
            ", ".join(dict.fromkeys(ended)) or "-",
        ]


def write_report(out: Path, content: dict[str, Any]) -> Path:
    """Write `content`, a result of `compare`, as an HTML page into the folder `out`; return the
    page's path."""
    sections = []
    for (perception, disturbance), drives in groups(content):
        head, rows = score_table(drives)
        sections.append(
            {
                "perception": perception,
                "disturbance": disturbance,
                "head": head,
                "rows": rows,
                "figures": list(figure_rows(drives)),
                "curves": [
                    (f"{entry['controller']} on {entry['track']}", *driving_curves(entry["curves"]))
                    for entry in drives
                    if "curves" in entry
                ],
            }
        )
    page = render(
        "controllers.compare",
        "report.html",
        settings=content["settings"],
        figure_head=FIGURES,
        sections=sections,
    )
    path = out / REPORT
    atomic_write(path, page)
    return path


def driving_curves(curves: dict[str, list[float | None]]) -> tuple[Markup, Markup]:
    """Return two charts over time (s) as in the paper's figures 12 and 13: the true and the
    perceived offset (m), and the true and the perceived angle (rad).

    `curves` is a result of `curves_of`.
    """
    columns = {
        name: np.array([np.nan if value is None else value for value in values])
        for name, values in curves.items()
    }

    def plot(title: str, true: str, perceived: str) -> Markup:
        lines = [
            Line("curve", columns["t"], columns[perceived], "perceived", PERCEIVED),
            Line("curve", columns["t"], columns[true], "true", TRUTH),
        ]
        return line_plot(Plot(title, lines, "s"))

    return plot("offset (m)", "d", "perceived_d"), plot("angle (rad)", "angle", "perceived_angle")


def _results(drives: list[dict[str, Any]], track: str, controller: str) -> list[dict[str, Any]]:
    return [
        entry["result"]
        for entry in drives
        if (entry["track"], entry["controller"]) == (track, controller)
    ]


def groups(content: dict[str, Any]) -> Iterator[tuple[tuple[str, str], list[dict[str, Any]]]]:
    """Yield ((perception, disturbance), drives) for the drives in a result of `compare`."""
    found: dict[tuple[str, str], list[dict[str, Any]]] = {}
    for entry in content["drives"]:
        found.setdefault((entry["perception"], entry["disturbance"]), []).append(entry)
    yield from found.items()
