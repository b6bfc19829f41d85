"""A line chart as SVG text: curves with a band each, and horizontal lines; the y axis is a log."""

from collections.abc import Sequence
from dataclasses import dataclass
from html import escape

import numpy as np
from numpy.typing import NDArray

WIDTH, HEIGHT = 560, 300
LEFT, RIGHT, TOP, FOOT = 58, 12, 12, 34


@dataclass(frozen=True)
class Line:
    """A curve through `values` (P,) at `x` (P,), within `low` and `high` (P,); all above 0."""

    label: str
    colour: str
    x: NDArray[np.float64]
    values: NDArray[np.float64]
    low: NDArray[np.float64]
    high: NDArray[np.float64]


@dataclass(frozen=True)
class Level:
    """A horizontal line."""

    label: str
    colour: str
    value: float


def line_chart(title: str, x_label: str, lines: Sequence[Line], levels: Sequence[Level]) -> str:
    """One figure with its legend; a note instead where there is nothing to draw."""
    if not lines and not levels:
        return f"<figure><figcaption>{escape(title)}</figcaption><p>not yet</p></figure>"
    values = np.concatenate(
        [[level.value for level in levels], *([i.low, i.high] for i in lines)], axis=None
    )
    low, high = np.log10(values.min() * 0.9), np.log10(values.max() * 1.1)
    last = max((float(line.x[-1]) for line in lines), default=1.0)

    def place(x: float, y: float) -> str:
        across = LEFT + x / last * (WIDTH - LEFT - RIGHT)
        up = (np.log10(y) - low) / (high - low)
        return f"{across:.1f},{HEIGHT - FOOT - up * (HEIGHT - FOOT - TOP):.1f}"

    drawn = []
    for value in ticks(10**low, 10**high):
        x, y = place(0, value).split(",")
        drawn.append(f'<line x1="{x}" x2="{WIDTH - RIGHT}" y1="{y}" y2="{y}" class="grid-line"/>')
        drawn.append(f'<text x="{LEFT - 6}" y="{float(y) + 3.5:.1f}" class="end">{value:g}</text>')
    for line in lines:
        if not np.array_equal(line.low, line.high):
            there = [place(x, y) for x, y in zip(line.x, line.high, strict=True)]
            back = [place(x, y) for x, y in zip(line.x[::-1], line.low[::-1], strict=True)]
            drawn.append(
                f'<polygon points="{" ".join(there + back)}" fill="{line.colour}" class="band"/>'
            )
        points = " ".join(place(x, y) for x, y in zip(line.x, line.values, strict=True))
        drawn.append(f'<polyline points="{points}" stroke="{line.colour}"/>')
    for level in levels:
        points = f"{place(0, level.value)} {place(last, level.value)}"
        drawn.append(f'<polyline points="{points}" stroke="{level.colour}" class="level"/>')
    foot = HEIGHT - FOOT + 16
    drawn += [
        f'<text x="{LEFT}" y="{foot}">0</text>',
        f'<text x="{WIDTH - RIGHT}" y="{foot}" class="end">{last:,.0f}</text>',
        f'<text x="{WIDTH / 2:g}" y="{foot}" class="middle">{escape(x_label)}</text>',
    ]
    named = [(i.colour, i.label) for i in lines] + [(i.colour, i.label) for i in levels]
    legend = "".join(
        f'<span><i style="background:{colour}"></i>{escape(label)}</span>'
        for colour, label in named
    )
    return (
        f"<figure><figcaption>{escape(title)}</figcaption>"
        f'<svg viewBox="0 0 {WIDTH} {HEIGHT}" role="img" aria-label="{escape(title)}">'
        f"{''.join(drawn)}</svg><p class=legend>{legend}</p></figure>"
    )


def ticks(low: float, high: float) -> list[float]:
    """Round values of a logarithmic axis between two positive numbers: 1, 2 and 5 of a decade."""
    decades = range(int(np.floor(np.log10(low))), int(np.ceil(np.log10(high))) + 1)
    found = [float(f"{digit}e{decade}") for decade in decades for digit in (1, 2, 5)]
    inside = [value for value in found if low <= value <= high]
    tens = [value for value in inside if f"{value:e}".startswith("1")]
    return tens if len(tens) > 4 else inside
