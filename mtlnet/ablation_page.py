"""The page of an ablation: one HTML file that needs nothing beside it."""

from collections.abc import Sequence
from html import escape
from importlib.resources import files
from string import Template
from typing import Any

import numpy as np

from mtlnet.ablation import AblationConfig, Row, Run
from mtlnet.ablation_table import ERRORS, LOSSES, PAPER_COLUMNS, best, training_curve
from mtlnet.axes import Numbers
from mtlnet.charts import Line, Plot, plot, style
from mtlnet.loss import TASKS

COLOURS = ("#3b6fd4", "#e07a2e", "#2a9d5c", "#c23b6b")
SINGLE = "#6a3fb5"  # the paper's purple line
END = 0.05  # the share of a run over which its final loss is averaged
Column = tuple[str, str, str, int, int]
PAPER_DIGITS = {"distance_absolute": 5, "angle_absolute": 5, "accuracy": 2}
NONE = '<td class="none">&ndash;'


def page(
    config: AblationConfig, entries: Sequence[dict[str, Any]], rows: Sequence[Row], runs: list[Run]
) -> str:
    """HTML of the table beside the paper's, every marking, and the training curves."""
    finished = sum(run.state == "finished" for run in runs)
    frames = next((entry["frames"] for entry in entries if entry["frames"]), 0)
    template = Template(files("mtlnet").joinpath("ablation.html").read_text(encoding="utf-8"))
    return template.substitute(
        chart_style=style(),
        summary=f"{finished} of {len(runs)} runs of {config.iterations:,} iterations each, judged "
        f"on {frames:,} {escape(config.split)} frames.",
        settings=f"Data <code>{escape(str(config.data))}</code>, recipe {escape(config.recipe)}, "
        f"batches of {config.batch}, seeds {', '.join(map(str, config.seeds))}.",
        losses=_table(entries, LOSSES),
        errors=_table(entries, ERRORS),
        charts="".join(_chart(number, rows, runs) for number in range(len(TASKS))),
    )


def _table(entries: Sequence[dict[str, Any]], columns: Sequence[Column]) -> str:
    """Rows that learn something of the `columns`, the paper's figures beside ours."""
    winners = {name: best(entries, name) for name, *_ in columns}
    heads = "".join(
        f"<th>{title}<br><small>{unit}</small>"
        + ('<th class="paper">paper' if name in PAPER_COLUMNS else "")
        for name, title, unit, _, _ in columns
    )
    body = []
    for i, entry in enumerate(entries):
        if all(entry["row"]["alpha"][task] == 0 for *_, task in columns):
            continue
        cells = []
        for name, _, _, digits, _ in columns:
            scale = 100.0 if name == "accuracy" else 1.0
            cells.append(_cell(entry["figures"][name], digits, scale, bold=winners[name] == i))
            if name in PAPER_COLUMNS:
                value = entry["row"]["paper"][PAPER_COLUMNS.index(name)]
                cells.append(
                    '<td class="paper">'
                    + ("" if value is None else f"{value * scale:.{PAPER_DIGITS[name]}f}")
                )
        part = ' class="part"' if entry["row"]["name"] in ("mtl-1", "deepdriving") else ""
        body.append(f"<tr{part}>{_title(entry)}{''.join(cells)}")
    return f"<table><thead><tr><th>row<th>alpha{heads}<tbody>{''.join(body)}</table>"


def _title(entry: dict[str, Any]) -> str:
    alpha = ", ".join(f"{weight:g}" for weight in entry["row"]["alpha"])
    return f"<th>{escape(entry['row']['title'])}<td>{alpha}"


def _cell(value: dict[str, Any] | None, digits: int, scale: float, *, bold: bool = False) -> str:
    if value is None:
        return NONE
    spread = ""
    if value["std"] is not None:
        spread = f" <small>&plusmn; {value['std'] * scale:.{digits}f}</small>"
    mark = ' class="best"' if bold else ""
    return f"<td{mark}>{value['mean'] * scale:.{digits}f}{spread}"


def _chart(task: int, rows: Sequence[Row], runs: Sequence[Run]) -> str:
    """The training loss of one task: MTL 1 to 4, and where the task ends when learned alone."""
    name = TASKS[task]
    together = [row for row in rows if row.network == "mtl" and sum(a > 0 for a in row.alpha) > 1]
    lines, last = [], 1.0
    for colour, row in zip(COLOURS, together, strict=False):
        curve = training_curve(runs, row, name)
        if curve is not None:
            steps, losses = curve
            last = max(last, float(steps[-1]))
            alpha = ", ".join(f"{weight:g}" for weight in row.alpha)
            label = f"{row.title} ({alpha})"
            band = losses.min(0), losses.max(0)
            lines.append(Line("curve", steps, losses.mean(0), label, colour, band))
    alone = next((row for row in rows if row.name == name), None)
    curve = training_curve(runs, alone, name) if alone is not None else None
    if curve is not None:
        lines.append(_level(curve[1], last, f"{name} alone, at the end"))
    return plot(Plot(f"({'abc'[task]}) {name}", lines, "iterations", log=True))


def _level(losses: Numbers, last: float, label: str) -> Line:
    """The mean over the end of losses (seeds, P), as a line up to x = `last`."""
    end = max(1, round(END * losses.shape[1]))
    level = np.full(2, losses[:, -end:].mean())
    return Line("level", np.array([0.0, last]), level, label, SINGLE)
