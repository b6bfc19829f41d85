"""Results as tables for people."""

from typing import Any

from rich.table import Table

import trackfeatures as tf


def evaluation_table(result: dict[str, Any]) -> Table:
    """Errors of a model beside those of always answering the training mean."""
    title = f"{result['model']} on {result['frames']} {result['split']} frames of {result['data']}"
    table = Table(title=title)
    for column in ("", "error", "of the mean's answer", "ratio"):
        table.add_column(column, justify="left" if not column else "right")
    base, ratio = result["baseline"], result["ratio"]
    for m in tf.MARKINGS:
        values = (result["mae_m"][m], base["mae_m"][m], ratio["mae_m"][m])
        table.add_row(f"distance to {m}", *_cells(values, "m", 3))
    for name, label, unit, digits in (
        ("to_lane_centre_mae_m", "offset from the lane centre", "m", 3),
        ("angle_mae_rad", "angle", "rad", 4),
    ):
        values = (result[name], base[name], ratio[name])
        table.add_row(label, *_cells(values, unit, digits))
    accuracy = (result["heading_accuracy"], base["heading_accuracy"])
    table.add_row("class accuracy", *(f"{100 * a:.1f} %" for a in accuracy), "")
    return table


def group_table(result: dict[str, Any]) -> Table:
    """The same by track and by lane count, shorter."""
    table = Table(title="by track and by lanes")
    for column in ("", "frames", "ml (m)", "mr (m)", "angle (rad)", "class"):
        table.add_column(column, justify="left" if not column else "right")
    for group, suffix in (("by_track", ""), ("by_lanes", " lane(s)")):
        for key, part in result[group].items():
            table.add_row(
                f"{key}{suffix}",
                str(part["frames"]),
                *(_number(part["mae_m"][m], 3) for m in ("ml", "mr")),
                _number(part["angle_mae_rad"], 4),
                f"{100 * part['heading_accuracy']:.1f} %",
            )
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


def _cells(values: tuple[float | None, ...], unit: str, digits: int) -> tuple[str, str, str]:
    error, base, ratio = values
    with_unit = [f"{_number(v, digits)} {unit}" if v is not None else "-" for v in (error, base)]
    return with_unit[0], with_unit[1], _number(ratio, 2)


def _number(value: float | None, digits: int) -> str:
    return "-" if value is None else f"{value:.{digits}f}"
