"""Formats the results of the `mtlnet` commands as tables and text for the terminal."""

from typing import Any

from rich.markup import escape
from rich.table import Table

import trackfeatures as tf
from mtlnet.evaluation.metrics import GROUPS, feature_mean
from mtlnet.inference.prediction import FEATURES
from runtime.cli import printable
from runtime.html import format_number, format_percent

TITLES = {
    **{m: f"to {m} (m)" for m in tf.MARKINGS},
    "to_lane_centre": "to lane centre (m)",
    "angle": "angle (rad)",
}
DIGITS = {name: 4 if name == "angle" else 3 for name in FEATURES}


def error_cells(result: dict[str, Any], name: str) -> list[str]:
    """Return the six table cells of the errors of feature `name` in `result`: mean, median, 95th
    and 99th percentile, mean error of the baseline (the training mean), and ratio of the two mean
    errors."""
    baseline, ratio = (feature_mean(result[part], name) for part in ("baseline", "ratio"))
    sizes = [*(result["errors"][name][k] for k in ("mean", "median", "p95", "p99")), baseline]
    return [*(format_number(v, DIGITS[name]) for v in sizes), format_number(ratio, 2)]


def mean_error_cells(result: dict[str, Any]) -> list[str]:
    """Return seven table cells, each with the mean error of one of `FEATURES`."""
    return [format_number(result["errors"][f]["mean"], DIGITS[f]) for f in FEATURES]


def report_tables(result: dict[str, Any]) -> list[Table]:
    """Make the tables of a report of `mtlnet evaluate`, one for each part of the report."""
    makers = {
        "protocol": protocol_table,
        "mae_m": evaluation_table,
        "pictures": picture_table,
        "by_track": group_table,
        "uncertainty": uncertainty_table,
    }
    return [make(result) for part, make in makers.items() if part in result]


def evaluation_table(result: dict[str, Any]) -> Table:
    """Make the table of a model's errors on active labels, and of the errors of a baseline that
    always answers the training mean."""
    title = f"{result['model']} on {result['frames']} {result['split']} frames of {result['data']}"
    table = Table(title=escape(printable(title + _views(result))))
    for column in ("", "mean", "median", "95 %", "99 %", "training mean", "ratio"):
        table.add_column(column, justify="left" if not column else "right", no_wrap=not column)
    for name, title in TITLES.items():
        table.add_row(title, *error_cells(result, name))
    accuracy, base = (
        format_percent(part["heading_accuracy"]) for part in (result, result["baseline"])
    )
    table.add_row("class right", accuracy, "", "", "", base, "")
    return table


def protocol_table(result: dict[str, Any]) -> Table:
    """Make the table of the paper's protocol, with the paper's figures in brackets; it fits in 80
    columns."""
    title = f"{result['model']} by the paper's protocol (in brackets: the paper)"
    table = Table(title=escape(printable(title + _views(result))))
    table.add_column("")
    for column in ("frames", "distance (m)", "angle (rad)", "class"):
        table.add_column(column, justify="right", no_wrap=True)
    for name, row in result["protocol"].items():
        paper = row["paper"]
        figures = (
            (format_number(row["distance_m"], 3), f"{paper.get('distance_m', '')}"),
            (format_number(row["angle_rad"], 4), f"{paper.get('angle_rad', '')}"),
            (format_percent(row["heading_accuracy"]), _percent(paper.get("heading_accuracy"))),
        )
        cells = (f"{own} ({stated})" if stated else own for own, stated in figures)
        table.add_row(name, str(row["frames"]), *cells)
    return table


def _views(result: dict[str, Any]) -> str:
    """Return a text about the number of views of each image; empty if it is 1."""
    count = result.get("views", 1)
    return f", answers averaged over {count} views of each image" if count > 1 else ""


def _percent(stated: float | None) -> str:
    return "" if stated is None else format_percent(stated, 2)


def group_table(result: dict[str, Any]) -> Table:
    """Make the table of mean absolute errors in groups of frames: by track, lane count, light,
    shadow, radius of the bend, and speed."""
    table = Table(title="by groups (m, rad)", box=None, padding=(0, 0, 0, 1))
    short = ("centre" if name == "to_lane_centre" else name for name in FEATURES)
    for column in ("", "frames", *short, "class"):
        table.add_column(column, justify="left" if not column else "right", no_wrap=True)
    for group, label in GROUPS.items():
        table.add_section()
        table.add_row(f"[bold]{label}")
        for key, part in result[group].items():
            accuracy = f"{100 * part['heading_accuracy']:.1f}%"
            table.add_row(key, str(part["frames"]), *mean_error_cells(part), accuracy)
    return table


def picture_table(result: dict[str, Any]) -> Table:
    """Make the table of mean absolute errors on a user's own pictures, by group of pictures."""
    figures = result["pictures"]
    title = (
        f"{figures['cases']} pictures: {figures['refused']} refused, {figures['absent']} absent, "
        f"{figures['out_of_distribution'] or 0} out of distribution{_views(result)}"
    )
    table = Table(title=title, box=None, padding=(0, 0, 0, 1))
    for column in ("", "pictures", "left (m)", "right", "width", "centre", "heading (rad)"):
        table.add_column(column, justify="left" if not column else "right", no_wrap=True)
    _add_picture_row(table, "all", figures["cases"], figures["mean"])
    _add_picture_row(table, "always the labels' median", "", figures["always_median"])
    for grouping in ("by_training", "by_drive", "by_light", "by_copy"):
        table.add_section()
        for name, part in figures.get(grouping, {}).items():
            _add_picture_row(table, printable(name), part["cases"], part["mean"])
    return table


def _add_picture_row(
    table: Table, name: str, count: int | str, means: dict[str, float | None]
) -> None:
    cells = [format_number(v, 4 if k == "angle" else 3) for k, v in means.items()]
    table.add_row(escape(name), str(count), *cells)


def uncertainty_table(result: dict[str, Any]) -> Table:
    """Make the table of the shares of errors within one and two predicted standard deviations, with
    the share of frames classified as out of distribution in its title."""
    uncertainty = result["uncertainty"]
    share = (
        f"{uncertainty['out_of_distribution']:.1%} of the frames classified as out of distribution"
    )
    table = Table(title=f"standard deviations; {share}")
    for column in ("", "within 1 (68.3 %)", "within 2 (95.4 %)"):
        table.add_column(column, justify="left" if not column else "right")
    for name, shares in uncertainty["coverage"].items():
        table.add_row(name, *(format_percent(share) for share in shares))
    return table


def prediction_table(predictions: list[dict[str, Any]]) -> Table:
    """Make the table of the track features predicted for images."""
    table = Table(title="track features (m, rad)", box=None, padding=(0, 0, 0, 1))
    table.add_column("image", overflow="fold")
    for column in (*tf.MARKINGS, "to lane centre", "angle", "heading"):
        table.add_column(column, justify="right", no_wrap=True)
    for prediction in predictions:
        heading = max(prediction["heading"], key=prediction["heading"].__getitem__)
        table.add_row(
            escape(printable(prediction["image"])),
            *(format_number(prediction["distances_m"][m], 2) for m in tf.MARKINGS),
            format_number(prediction["to_lane_centre_m"], 2),
            format_number(prediction["angle_rad"], 4),
            f"{heading} {100 * prediction['heading'][heading]:.0f} %",
        )
    return table


def export_lines(result: dict[str, Any]) -> str:
    """Return the result of an export as text: files, differences from torch, accuracy gate."""
    check, gate = result["check"], result.get("gate")
    lines = [
        f"{result['out']}: {', '.join(result['files'])}",
        f"largest difference from torch on {check['frames']} frames: {check['coded']:.2g} (coded), "
        f"{check['probability']:.2g} (probability), computed in {check['computed_in']}",
    ]
    if gate is not None:
        worse = ", ".join(f"{name} {by:+.5f}" for name, by in gate["worse"].items())
        lines.append(f"error against float32 on {gate['frames']} test frames: {worse}")
        verdict = "passed: engines take int8 by default"
        if not gate["passed"]:
            verdict = f"FAILED by {', '.join(gate['failed'])}: engines do not take int8 by default"
        lines.append(f"accuracy gate {verdict}")
    return "\n".join(lines)
