"""Results as tables for people."""

from typing import Any

from rich.table import Table

import trackfeatures as tf
from mtlnet.evaluation.slices import GROUPS
from mtlnet.inference.uncertainty import FEATURES

ROWS = {
    **{m: (f"to {m} (m)", 3) for m in tf.MARKINGS},
    "to_lane_centre": ("to lane centre (m)", 3),
    "angle": ("angle (rad)", 4),
}


def evaluation_table(result: dict[str, Any]) -> Table:
    """Errors of a model on active labels, beside those of always answering the training mean."""
    title = f"{result['model']} on {result['frames']} {result['split']} frames of {result['data']}"
    table = Table(title=title)
    for column in ("", "mean", "median", "95 %", "99 %", "mean's answer", "ratio"):
        table.add_column(column, justify="left" if not column else "right", no_wrap=not column)
    for name, (label, digits) in ROWS.items():
        base, ratio = (_of(result[part], name) for part in ("baseline", "ratio"))
        sizes = [*(result["errors"][name][k] for k in ("mean", "median", "p95", "p99")), base]
        cells = [_number(v, digits) for v in sizes]
        table.add_row(label, *cells, _number(ratio, 2))
    accuracy, base = (result["heading_accuracy"], result["baseline"]["heading_accuracy"])
    table.add_row("class right", f"{100 * accuracy:.1f} %", "", "", "", f"{100 * base:.1f} %", "")
    return table


def _of(part: dict[str, Any], name: str) -> float | None:
    """The figure of a feature under the names of DESIGN §9."""
    names = {"to_lane_centre": "to_lane_centre_mae_m", "angle": "angle_mae_rad"}
    found: float | None = part[names[name]] if name in names else part["mae_m"][name]
    return found


def group_table(result: dict[str, Any]) -> Table:
    """Mean absolute errors by track, lane count, light, shadow, bend and speed."""
    table = Table(title="by groups (m, rad)", box=None, padding=(0, 0, 0, 1))
    short = ("centre" if name == "to_lane_centre" else name for name in FEATURES)
    for column in ("", "frames", *short, "class"):
        table.add_column(column, justify="left" if not column else "right", no_wrap=True)
    for group, label in GROUPS.items():
        table.add_section()
        table.add_row(f"[bold]{label}")
        for key, part in result[group].items():
            table.add_row(
                key,
                str(part["frames"]),
                *(_number(part["errors"][f]["mean"], 4 if f == "angle" else 3) for f in FEATURES),
                f"{100 * part['heading_accuracy']:.1f}%",
            )
    return table


def doubt_table(result: dict[str, Any]) -> Table:
    """How many errors were as small as the model said, and how many frames it called strange."""
    doubt = result["doubt"]
    strange = f"{doubt['out_of_distribution']:.1%} of the frames called out of distribution"
    table = Table(title=f"standard deviations; {strange}")
    for column in ("", "within 1 (68.3 %)", "within 2 (95.4 %)"):
        table.add_column(column, justify="left" if not column else "right")
    for name, shares in doubt["coverage"].items():
        table.add_row(name, *("-" if s is None else f"{100 * s:.1f} %" for s in shares))
    return table


def answer_table(answers: list[dict[str, Any]]) -> Table:
    """Track features of images."""
    table = Table(title="track features")
    table.add_column("image")
    for m in tf.MARKINGS:
        table.add_column(f"{m} (m)", justify="right")
    for column in ("to lane centre (m)", "angle (rad)", "heading"):
        table.add_column(column, justify="right")
    for answer in answers:
        best = max(answer["heading"], key=answer["heading"].__getitem__)
        table.add_row(
            answer["image"],
            *(_number(answer["distances_m"][m], 2) for m in tf.MARKINGS),
            _number(answer["to_lane_centre_m"], 2),
            _number(answer["angle_rad"], 4),
            f"{best} {100 * answer['heading'][best]:.0f} %",
        )
    return table


def _number(value: float | None, digits: int) -> str:
    return "-" if value is None else f"{value:.{digits}f}"


def export_lines(result: dict[str, Any]) -> str:
    """What came of an export: where it is, how far from torch, and its gate."""
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
