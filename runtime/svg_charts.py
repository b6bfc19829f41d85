"""Axes of charts: where a value lies, and the round numbers beside it; linear or logarithmic."""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from html import escape
from importlib.resources import files
from itertools import groupby

import numpy as np
from numpy.typing import NDArray

SIDE = 1000.0  # of a chart's own coordinates, both ways
LEAST = 1e-9  # what a logarithmic axis takes 0 for

Numbers = NDArray[np.float64]


@dataclass(frozen=True)
class Axis:
    """Values -> [0, SIDE], from `first` to `last`; `log`: by their logarithms."""

    first: float
    last: float
    log: bool = False

    def __call__(self, value: float) -> float:
        first, last, here = (
            math.log10(max(v, LEAST)) if self.log else v for v in (self.first, self.last, value)
        )
        return (here - first) * SIDE / ((last - first) or 1.0)

    @property
    def ticks(self) -> list[float]:
        """Round numbers on this axis, ascending."""
        low, high = sorted((self.first, self.last))
        return log_ticks(max(low, LEAST), max(high, LEAST)) if self.log else ticks(low, high)


def span(columns: Iterable[Numbers], *, log: bool) -> tuple[float, float]:
    """What an axis must reach from and to for all finite values of `columns`, with a margin."""
    values = np.concatenate([column[np.isfinite(column)] for column in columns])
    if not len(values):
        return (LEAST, 1.0) if log else (-1.0, 1.0)
    low, high = float(values.min()), float(values.max())
    if log:
        return max(low, LEAST) * 0.9, max(high, LEAST) * 1.1
    margin = 0.06 * (high - low) or 0.5
    return low - margin, high + margin


def ticks(low: float, high: float) -> list[float]:
    """Round numbers within, three to eight of them; none within nothing."""
    if not high > low:
        return []
    step = 10 ** math.floor(math.log10((high - low) / 3))
    step *= next(m for m in (5, 2, 1) if (high - low) / (m * step) >= 3 or m == 1)
    first = math.ceil(low / step)
    return [round(n * step, 10) for n in range(first, math.floor(high / step) + 1)]


def log_ticks(low: float, high: float) -> list[float]:
    """Round values between two positive numbers: 1, 2 and 5 of a decade, or only 1 of many."""
    decades = range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
    found = [float(f"{digit}e{decade}") for decade in decades for digit in (1, 2, 5)]
    inside = [value for value in found if low <= value <= high]
    tens = [value for value in inside if f"{value:e}".startswith("1")]
    return tens if len(tens) > 4 else inside


# Charts of HTML pages: SVG stretched over its box, with labels in HTML beside it. The lines
# stretch with the page and the text does not, so that both are readable on a phone. A page with
# charts has `style` in its own.


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
    return files("runtime").joinpath("svg_charts.css").read_text(encoding="utf-8")


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
