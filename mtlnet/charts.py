"""Charts of the evaluation report: SVG stretched over its box, with labels in HTML beside it.

The lines stretch with the page and the text does not, so that both are readable on a phone.
"""

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from html import escape

import numpy as np
from numpy.typing import NDArray

MOST_POINTS = 800
SIDE = 1000.0  # of the SVG's own coordinates, both ways

Numbers = NDArray[np.float64]


@dataclass(frozen=True)
class Line:
    """A line: `kind` is its class in the page's style. NaN breaks it."""

    kind: str
    y: Numbers


@dataclass(frozen=True)
class Plot:
    """Lines over one x, a band (low, high) behind them, shaded spans (from, to) of x."""

    title: str
    unit: str
    x: Numbers
    lines: Sequence[Line]
    x_unit: str = ""
    band: tuple[Numbers, Numbers] | None = None
    shaded: Sequence[tuple[float, float]] = field(default_factory=tuple)


def plot(what: Plot) -> str:
    """The figure."""
    low, high = _range([line.y for line in what.lines])
    left, right = float(what.x.min()), float(what.x.max())
    across, up = _Axis(left, right), _Axis(high, low)  # SVG's y points down
    drawn = [
        f'<rect class=shade x="{across(a):.1f}" width="{across(b) - across(a):.1f}" height="1000"/>'
        for a, b in what.shaded
    ]
    ticks = list(_ticks(low, high))
    drawn += [f'<path class=grid d="M0,{up(t):.1f}H1000"/>' for t in ticks]
    if what.band is not None:
        drawn.append(_band(across, up, what.x, *(edge.clip(low, high) for edge in what.band)))
    for line in what.lines:
        drawn.append(f'<path class="{line.kind}" d="{_path(across, up, what.x, line.y)}"/>')
    labels = [f'<span class=y style="top:{up(t) / 10:.1f}%">{t:g}</span>' for t in ticks]
    labels += [
        f'<span class=x style="left:{across(t) / 10:.1f}%">{t:g}</span>'
        for t in _ticks(left, right)
    ]
    return _figure(f"{what.title} ({what.unit})", drawn, labels, what.x_unit)


def reliability(title: str, unit: str, said: Numbers, found: Numbers) -> str:
    """Errors found against standard deviations said, both axes logarithmic, the diagonal drawn."""
    both = np.log10(np.maximum(np.concatenate([said, found]), 1e-9))
    low, high = float(both.min()) - 0.1, float(both.max()) + 0.1
    across, up = _Axis(low, high), _Axis(high, low)
    dots = [
        f'<path class=dot d="M{across(math.log10(max(s, 1e-9))):.1f},'
        f'{up(math.log10(max(f, 1e-9))):.1f}h0"/>'
        for s, f in zip(said.tolist(), found.tolist(), strict=True)
    ]
    ends = [10**low, 10**high]
    labels = [
        f'<span class=y style="top:97%">{ends[0]:.2g}</span>',
        f'<span class=y style="top:3%">{ends[1]:.2g}</span>',
        f'<span class=x style="left:0%">{ends[0]:.2g}</span>',
        f'<span class=x style="left:100%">{ends[1]:.2g}</span>',
    ]
    diagonal = '<path class=grid d="M0,1000L1000,0"/>'
    return _figure(f"{title} ({unit})", [diagonal, *dots], labels, "said", "square")


class _Axis:
    """Values -> [0, 1000], from `first` to `last`."""

    def __init__(self, first: float, last: float) -> None:
        self._first, self._scale = first, SIDE / ((last - first) or 1.0)

    def __call__(self, value: float) -> float:
        return (value - self._first) * self._scale


def _range(columns: Iterable[Numbers]) -> tuple[float, float]:
    values = np.concatenate([column[np.isfinite(column)] for column in columns])
    if not len(values):
        return -1.0, 1.0
    low, high = float(values.min()), float(values.max())
    margin = 0.06 * (high - low) or 0.5
    return low - margin, high + margin


def _ticks(low: float, high: float) -> Iterator[float]:
    """Round numbers within, three to six of them; none within nothing."""
    if not high > low:
        return
    step = 10 ** math.floor(math.log10((high - low) / 3))
    step *= next(m for m in (5, 2, 1) if (high - low) / (m * step) >= 3 or m == 1)
    first = math.ceil(low / step)
    for number in range(first, math.floor(high / step) + 1):
        yield round(number * step, 10)


def _path(across: _Axis, up: _Axis, x: Numbers, y: Numbers) -> str:
    parts, drawing = [], False
    for a, b in zip(x.tolist(), y.tolist(), strict=True):
        if not math.isfinite(b):
            drawing = False
            continue
        parts.append(f"{'L' if drawing else 'M'}{across(a):.1f},{up(b):.1f}")
        drawing = True
    return "".join(parts)


def _band(across: _Axis, up: _Axis, x: Numbers, low: Numbers, high: Numbers) -> str:
    drawn = []
    present = np.isfinite(low) & np.isfinite(high)
    for rows in np.split(np.arange(len(x)), np.flatnonzero(np.diff(present)) + 1):
        if len(rows) and present[rows[0]]:
            ring = [*zip(x[rows], high[rows], strict=True)]
            ring += zip(x[rows][::-1], low[rows][::-1], strict=True)
            drawn.append("M" + "L".join(f"{across(a):.1f},{up(b):.1f}" for a, b in ring) + "Z")
    return f'<path class=band d="{"".join(drawn)}"/>'


def _figure(
    title: str, drawn: Iterable[str], labels: Iterable[str], x_unit: str, kind: str = "wide"
) -> str:
    name = escape(title)
    return (
        f'<figure class="chart {kind}"><figcaption>{name}</figcaption><div class=plot>'
        f'<svg viewBox="0 0 1000 1000" preserveAspectRatio=none role=img aria-label="{name}">'
        f"{''.join(drawn)}</svg>{''.join(labels)}<span class=unit>{escape(x_unit)}</span></div>"
        "</figure>"
    )
