"""Charts of HTML pages: SVG stretched over its box, with labels in HTML beside it.

The lines stretch with the page and the text does not, so that both are readable on a phone. A page
with charts has `style` in its own.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from html import escape
from importlib.resources import files
from itertools import groupby

import numpy as np

from mtlnet.axes import LEAST, SIDE, Axis, Numbers, span

MOST_POINTS = 800


@dataclass(frozen=True)
class Line:
    """A line through y (N,) at x (N,), NaN breaks it; `band` (low, high) lies behind it.

    `kind`: its class in the page's style. With a `label` it is named in the legend, and has its
    own `colour`.
    """

    kind: str
    x: Numbers
    y: Numbers
    label: str = ""
    colour: str = ""
    band: tuple[Numbers, Numbers] | None = None


@dataclass(frozen=True)
class Plot:
    """Lines, and shaded spans (from, to) of x behind them; `log`: up, logarithms."""

    title: str
    lines: Sequence[Line]
    x_unit: str = ""
    shaded: Sequence[tuple[float, float]] = ()
    log: bool = False


def style() -> str:
    """What the style of a page with charts must hold."""
    return files("mtlnet").joinpath("charts.css").read_text(encoding="utf-8")


def plot(what: Plot) -> str:
    """The figure; a note in its place where there is nothing to draw."""
    if not what.lines:
        return f"<figure><figcaption>{escape(what.title)}</figcaption><p>not yet</p></figure>"
    # The bands of charts with names belong to them; others may be cut off, the line may not.
    fitted = [line.y for line in what.lines]
    fitted += [edge for line in what.lines if line.label for edge in line.band or ()]
    low, high = span(fitted, log=what.log)
    xs = np.concatenate([line.x for line in what.lines])
    across, up = Axis(float(xs.min()), float(xs.max())), Axis(high, low, what.log)  # y points down
    drawn = [
        f'<rect class=shade x="{across(a):.1f}" y="0" width="{across(b) - across(a):.1f}" '
        f'height="{SIDE:.0f}"/>'
        for a, b in what.shaded
    ]
    drawn += [f'<path class=grid d="M0,{up(t):.1f}H{SIDE:.0f}"/>' for t in up.ticks]
    drawn += [_band(across, up, line) for line in what.lines if line.band is not None]
    drawn += [
        f'<path class="{line.kind}"{_colour("stroke", line)} d="{_path(across, up, line)}"/>'
        for line in what.lines
    ]
    labels = [_label("y", up(t), t) for t in up.ticks]
    labels += [_label("x", across(t), t) for t in across.ticks]
    return _figure(what.title, drawn, labels, what.x_unit, legend=_legend(what.lines))


def reliability(title: str, said: Numbers, found: Numbers) -> str:
    """Errors found against standard deviations said, both axes logarithmic, the diagonal drawn."""
    both = np.maximum(np.concatenate([said, found]), LEAST)
    low, high = float(both.min()) * 0.8, float(both.max()) * 1.25
    across, up = Axis(low, high, log=True), Axis(high, low, log=True)
    dots = [
        f'<path class=dot d="M{across(s):.1f},{up(f):.1f}h0"/>'
        for s, f in zip(said.tolist(), found.tolist(), strict=True)
    ]
    labels = [
        f'<span class=y style="top:97%">{low:.2g}</span>',
        f'<span class=y style="top:3%">{high:.2g}</span>',
        f'<span class=x style="left:0%">{low:.2g}</span>',
        f'<span class=x style="left:100%">{high:.2g}</span>',
    ]
    diagonal = f'<path class=grid d="M0,{SIDE:.0f}L{SIDE:.0f},0"/>'
    return _figure(title, [diagonal, *dots], labels, "said", "square")


def _path(across: Axis, up: Axis, line: Line) -> str:
    parts, drawing = [], False
    for x, y in zip(line.x.tolist(), line.y.tolist(), strict=True):
        present = bool(np.isfinite(y))
        if present:
            parts.append(f"{'L' if drawing else 'M'}{across(x):.1f},{up(y):.1f}")
        drawing = present
    return "".join(parts)


def _band(across: Axis, up: Axis, line: Line) -> str:
    assert line.band is not None
    first, last = sorted((up.first, up.last))
    low, high = (edge.clip(first, last) for edge in line.band)
    present = np.isfinite(low) & np.isfinite(high)
    rings = []
    for here, rows in groupby(range(len(line.x)), key=lambda row: bool(present[row])):
        if here:
            there = list(rows)
            ring = [(line.x[i], high[i]) for i in there]
            ring += [(line.x[i], low[i]) for i in reversed(there)]
            rings.append("M" + "L".join(f"{across(x):.1f},{up(y):.1f}" for x, y in ring) + "Z")
    return f'<path class=band{_colour("fill", line)} d="{"".join(rings)}"/>'


def _colour(what: str, line: Line) -> str:
    return f' style="{what}:{line.colour}"' if line.colour else ""


def _label(side: str, place: float, value: float) -> str:
    edge = "top" if side == "y" else "left"
    return f'<span class={side} style="{edge}:{100 * place / SIDE:.1f}%">{value:g}</span>'


def _legend(lines: Iterable[Line]) -> str:
    named = [
        f'<span><i class={line.kind} style="border-color:{line.colour}"></i>'
        f"{escape(line.label)}</span>"
        for line in lines
        if line.label
    ]
    return f"<p class=legend>{''.join(named)}</p>" if named else ""


def _figure(
    title: str,
    drawn: Iterable[str],
    labels: Iterable[str],
    x_unit: str,
    kind: str = "wide",
    legend: str = "",
) -> str:
    name = escape(title)
    return (
        f'<figure class="chart {kind}"><figcaption>{name}</figcaption><div class=plot>'
        f'<svg viewBox="0 0 {SIDE:.0f} {SIDE:.0f}" preserveAspectRatio=none role=img '
        f'aria-label="{name}">{"".join(drawn)}</svg>{"".join(labels)}'
        f"<span class=unit>{escape(x_unit)}</span></div>{legend}</figure>"
    )
