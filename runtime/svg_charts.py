"""SVG charts for HTML pages: line plots, reliability diagrams, histograms and bars.

The SVG of a plot has coordinates from 0 to 1000 (SIDE), y down, and is stretched over its box.
Labels are HTML, so that the text does not scale with the box. Pages with charts include
`svg_charts.css`.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from markupsafe import Markup, escape
from numpy.typing import ArrayLike, NDArray

SIDE = 1000.0
LOG_FLOOR = 1e-9
"""A logarithmic axis draws smaller values, including 0, at this value."""
MAX_POINTS = 800
"""Largest useful number of points of a line. Callers should thin out longer lines, because a screen
does not show more points."""

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class Axis:
    """An axis from the value `first` to the value `last`; it is logarithmic if `log` is true.
    Calling the axis maps values to SVG coordinates, 0 at `first` and 1000 (SIDE) at `last`."""

    first: float
    last: float
    log: bool = False

    def __call__(self, values: ArrayLike) -> FloatArray:
        first, last, here = (
            np.log10(np.maximum(v, LOG_FLOOR)) if self.log else np.asarray(v, np.float64)
            for v in (self.first, self.last, values)
        )
        return np.asarray((here - first) * SIDE / ((last - first) or 1.0))

    @property
    def ticks(self) -> list[float]:
        """Round values on this axis, in ascending order."""
        low, high = sorted((self.first, self.last))
        return (
            log_ticks(max(low, LOG_FLOOR), max(high, LOG_FLOOR)) if self.log else ticks(low, high)
        )


def value_range(columns: Iterable[FloatArray], *, log: bool) -> tuple[float, float]:
    """Return the limits (low, high) of an axis that shows all finite values of `columns` with a
    margin."""
    values = np.concatenate([column[np.isfinite(column)] for column in columns])
    if not len(values):
        return (LOG_FLOOR, 1.0) if log else (-1.0, 1.0)
    low, high = float(values.min()), float(values.max())
    if log:
        return max(low, LOG_FLOOR) * 0.9, max(high, LOG_FLOOR) * 1.1
    margin = 0.06 * (high - low) or 0.5
    return low - margin, high + margin


def ticks(low: float, high: float) -> list[float]:
    """Return three to eight round numbers between `low` and `high`; none unless `high` > `low`."""
    if not high > low:
        return []
    step = 10 ** math.floor(math.log10((high - low) / 3))
    step *= next(m for m in (5, 2, 1) if (high - low) / (m * step) >= 3 or m == 1)
    first = math.ceil(low / step)
    return [round(n * step, 10) for n in range(first, math.floor(high / step) + 1)]


def log_ticks(low: float, high: float) -> list[float]:
    """Return the ticks between two positive numbers. The ticks are 1, 2 and 5 times each power of
    ten, or only the powers of ten if the range contains more than four of these."""
    decades = range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
    found = [float(f"{digit}e{decade}") for decade in decades for digit in (1, 2, 5)]
    inside = [value for value in found if low <= value <= high]
    tens = [value for value in inside if f"{value:e}".startswith("1")]
    return tens if len(tens) > 4 else inside


# Line plots and reliability diagrams.


@dataclass(frozen=True)
class Line:
    """A line through the points x (N,), y (N,), interrupted at NaN.

    `kind` is its class in `svg_charts.css`; `label` and `colour` appear in the legend. `band` is a
    pair (low, high) of bounds (N,); the area between them is filled behind the line.
    """

    kind: str
    x: FloatArray
    y: FloatArray
    label: str = ""
    colour: str = ""
    band: tuple[FloatArray, FloatArray] | None = None


@dataclass(frozen=True)
class Plot:
    """A plot of lines, with `shaded` intervals (from, to) of x behind them. With `log` the y axis
    is logarithmic."""

    title: str
    lines: Sequence[Line]
    x_unit: str = ""
    shaded: Sequence[tuple[float, float]] = ()
    log: bool = False


def line_plot(plot: Plot) -> Markup:
    """Draw the plot as an HTML figure; it has the text "not yet" if the plot has no lines."""
    if not plot.lines:
        note = Markup("<figure><figcaption>{}</figcaption><p>not yet</p></figure>")
        return note.format(plot.title)
    # The y axis covers all lines and the bands of labelled lines; other bands can be cut off.
    fitted = [line.y for line in plot.lines]
    fitted += [edge for line in plot.lines if line.label for edge in line.band or ()]
    low, high = value_range(fitted, log=plot.log)
    x = np.concatenate([line.x for line in plot.lines])
    x_axis = Axis(float(x.min()), float(x.max()))
    y_axis = Axis(high, low, plot.log)
    drawn = [
        f'<rect class=shade x="{x_axis(a):.1f}" y="0" width="{x_axis(b) - x_axis(a):.1f}" '
        f'height="{SIDE:.0f}"/>'
        for a, b in plot.shaded
    ]
    drawn += [f'<path class=grid d="M0,{y_axis(t):.1f}H{SIDE:.0f}"/>' for t in y_axis.ticks]
    drawn += [_band(x_axis, y_axis, line) for line in plot.lines if line.band is not None]
    drawn += [
        f'<path class="{line.kind}"{_colour("stroke", line)} d="{_path(x_axis, y_axis, line)}"/>'
        for line in plot.lines
    ]
    labels = [_tick_label("y", y_axis(t), t) for t in y_axis.ticks]
    labels += [_tick_label("x", x_axis(t), t) for t in x_axis.ticks]
    return _figure(plot.title, drawn, labels, plot.x_unit, legend=_legend(plot.lines))


def reliability_diagram(title: str, predicted: FloatArray, observed: FloatArray) -> Markup:
    """Draw the observed errors (N,) over the predicted standard deviations (N,), both in one unit,
    as an HTML figure with logarithmic axes. The diagonal shows where both are equal."""
    both = np.maximum(np.concatenate([predicted, observed]), LOG_FLOOR)
    low, high = float(both.min()) * 0.8, float(both.max()) * 1.25
    x_axis, y_axis = Axis(low, high, log=True), Axis(high, low, log=True)
    points = _points(x_axis, y_axis, predicted, observed)
    dots = [f'<path class=dot d="M{point}h0"/>' for point in points]
    corners = ("y", "top:97%", low), ("y", "top:3%", high), ("x", "left:0%", low)
    labels = [
        f'<span class={side} style="{at}">{value:.2g}</span>'
        for side, at, value in (*corners, ("x", "left:100%", high))
    ]
    diagonal = f'<path class=grid d="M0,{SIDE:.0f}L{SIDE:.0f},0"/>'
    return _figure(title, [diagonal, *dots], labels, "predicted", "square")


def _path(x_axis: Axis, y_axis: Axis, line: Line) -> str:
    points = _points(x_axis, y_axis, line.x, line.y)
    return "".join("M" + "L".join(points[run]) for run in runs(np.isfinite(line.y)))


def _band(x_axis: Axis, y_axis: Axis, line: Line) -> str:
    assert line.band is not None
    first, last = sorted((y_axis.first, y_axis.last))
    edges = [edge.clip(first, last) for edge in line.band]
    low, high = (_points(x_axis, y_axis, line.x, edge) for edge in edges)
    rings = (high[run] + low[run][::-1] for run in runs(np.isfinite(sum(edges))))
    path = "".join(f"M{'L'.join(ring)}Z" for ring in rings)
    return f'<path class=band{_colour("fill", line)} d="{path}"/>'


def _points(x_axis: Axis, y_axis: Axis, x: FloatArray, y: FloatArray) -> list[str]:
    return [f"{a:.1f},{b:.1f}" for a, b in zip(x_axis(x), y_axis(y), strict=True)]


def runs(present: NDArray[np.bool_]) -> list[slice]:
    """Return the slices of consecutive indices at which `present` (N,) is true."""
    edges = np.flatnonzero(np.diff(present, prepend=False, append=False))
    return [slice(a, b) for a, b in edges.reshape(-1, 2).tolist()]


def _colour(style: str, line: Line) -> str:
    return f' style="{style}:{line.colour}"' if line.colour else ""


def _tick_label(side: str, place: FloatArray, value: float) -> str:
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
) -> Markup:
    name = escape(title)
    return Markup(
        f'<figure class="chart {kind}"><figcaption>{name}</figcaption><div class=plot>'
        f'<svg viewBox="0 0 {SIDE:.0f} {SIDE:.0f}" preserveAspectRatio=none role=img '
        f'aria-label="{name}">{"".join(drawn)}</svg>{"".join(labels)}'
        f"<span class=unit>{escape(x_unit)}</span></div>{legend}</figure>"
    )


# Histograms (splits of a dataset on top of each other) and bars (one below the other).


BINS = 48
SPLIT_COLOURS = {"train": "#3b6fd4", "test": "#e07a2e", "unseen": "#2a9d5c"}
WIDTH, HEIGHT = 320, 120
MARGIN, FOOT = 6, 18
"""Space in a histogram in SVG units: MARGIN on the left and right, FOOT below for the labels."""


def histogram(title: str, unit: str, values: Mapping[str, NDArray[np.float32]]) -> Markup:
    """Draw a histogram with 48 equal bins (BINS) as an HTML figure. `values` has an array (N,) in
    `unit` for the name of each split of a dataset.

    NaN is an absent value; the figure states the share of values that are present. The heights of
    the bins of a split sum to one, so that splits of different sizes can be compared.
    """
    finite = {split: column[np.isfinite(column)] for split, column in values.items()}
    filled = [column for column in finite.values() if column.size]
    if not filled:
        return _histogram_figure(title, "never active")
    low = min(float(column.min()) for column in filled)
    high = max(float(column.max()) for column in filled)
    high = high if high > low else low + 1.0
    shares = {
        split: np.histogram(column, BINS, (low, high))[0] / max(column.size, 1)
        for split, column in finite.items()
    }
    top = max(float(share.max()) for share in shares.values())
    outlines = "".join(_outline(share / top, SPLIT_COLOURS[s]) for s, share in shares.items())
    active = ", ".join(
        f"{split} {column.size / max(len(values[split]), 1):.0%}"
        for split, column in finite.items()
    )
    note = "" if active.count("100%") == len(finite) else f" active: {active}"
    return _histogram_figure(title, f"{unit}{note}", _value_axis(low, high) + outlines)


def bars(title: str, counts: Mapping[str, Sequence[int]]) -> Markup:
    """Draw a bar chart as an HTML figure, with a row for each name in `counts`. The numbers of a
    row are the numbers of frames in the splits train, test and unseen, in this order. Each number
    has a bar."""
    top = max((max(row) for row in counts.values()), default=0) or 1
    rows = []
    for name, row in counts.items():
        cells = "".join(
            f'<i style="width:{100 * count / top:.1f}%;background:{colour}"></i>'
            for colour, count in zip(SPLIT_COLOURS.values(), row, strict=False)
        )
        numbers = " / ".join(f"{count:,}" for count in row)
        rows.append(f"<tr><th>{escape(name)}<td>{cells}<td class=count>{numbers}")
    return Markup(
        f"<figure class=bars><figcaption>{escape(title)}</figcaption>"
        f"<table>{''.join(rows)}</table></figure>"
    )


def _outline(share: FloatArray, colour: str) -> str:
    """Return the SVG polygon of a histogram with the bin heights `share` (BINS,) in [0, 1]."""
    x = _bin_x(np.repeat(np.linspace(0.0, 1.0, BINS + 1), 2))
    y = HEIGHT - FOOT - np.pad(np.repeat(share, 2), 1) * (HEIGHT - FOOT - 4)
    points = " ".join(f"{a:.1f},{b:.1f}" for a, b in zip(x, y, strict=True))
    return f'<polygon points="{points}" fill="{colour}" stroke="{colour}"/>'


def _value_axis(low: float, high: float) -> str:
    """Return the SVG of a histogram's axis from `low` to `high`: labels at both ends, and a line at
    zero if zero is between `low` and `high`."""
    drawn = _text(MARGIN, "start", f"{low:.3g}") + _text(WIDTH - MARGIN, "end", f"{high:.3g}")
    if low < 0.0 < high:
        zero = -low / (high - low)
        x = float(_bin_x(zero))
        drawn += f'<line x1="{x:.1f}" x2="{x:.1f}" y1="0" y2="{HEIGHT - FOOT}" class="zero"/>'
        if 0.12 < zero < 0.88:
            drawn += _text(x, "middle", "0")
    return drawn


def _bin_x(share: ArrayLike) -> FloatArray:
    return MARGIN + np.asarray(share) * (WIDTH - 2 * MARGIN)


def _text(x: float, anchor: str, text: str) -> str:
    return f'<text x="{x:.1f}" y="{HEIGHT - 4}" text-anchor="{anchor}">{text}</text>'


def _histogram_figure(title: str, note: str, drawn: str = "") -> Markup:
    svg = f'<svg viewBox="0 0 {WIDTH} {HEIGHT}" role="img">{drawn}</svg>' if drawn else ""
    return Markup(
        f"<figure class=histogram><figcaption>{escape(title)} <small>{escape(note)}</small>"
        f"</figcaption>{svg}</figure>"
    )
