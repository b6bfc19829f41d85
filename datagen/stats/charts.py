"""Small charts as SVG text: histograms of both sides over each other, and bars of shares."""

from collections.abc import Mapping, Sequence
from html import escape

import numpy as np
from numpy.typing import NDArray

WIDTH, HEIGHT, LEFT, FOOT = 320, 120, 6, 18
BINS = 48
COLOURS = {"train": "#3b6fd4", "test": "#e07a2e", "unseen": "#2a9d5c"}

Numbers = NDArray[np.float32]


def histogram(title: str, unit: str, values: Mapping[str, Numbers]) -> str:
    """One figure: the share of each side's present values (NaN is absent) in 48 equal bins.

    Shares of a side sum to one, so that sides of different sizes lie over each other.
    """
    present = {side: column[np.isfinite(column)] for side, column in values.items()}
    filled = [column for column in present.values() if column.size]
    if not filled:
        return _figure(title, "never active", "")
    low = min(float(column.min()) for column in filled)
    high = max(float(column.max()) for column in filled)
    high = high if high > low else low + 1.0
    shares = {
        side: np.histogram(column, BINS, (low, high))[0] / max(column.size, 1)
        for side, column in present.items()
    }
    top = max(float(share.max()) for share in shares.values())
    lines = "".join(_outline(share / top, COLOURS[side]) for side, share in shares.items())
    axis = _label(LEFT, "start", f"{low:.3g}") + _label(WIDTH - LEFT, "end", f"{high:.3g}")
    if low < 0.0 < high:
        x = _x(-low / (high - low))
        axis += f'<line x1="{x:.1f}" x2="{x:.1f}" y1="0" y2="{HEIGHT - FOOT}" class="zero"/>'
        if 0.12 < -low / (high - low) < 0.88:
            axis += _label(x, "middle", "0")
    active = ", ".join(
        f"{side} {column.size / max(len(values[side]), 1):.0%}" for side, column in present.items()
    )
    note = "" if active.count("100%") == len(present) else f" active: {active}"
    return _figure(title, f"{unit}{note}", axis + lines)


def bars(title: str, counts: Mapping[str, Sequence[int]]) -> str:
    """One figure: frames of each name, the sides (train, test, if there is one unseen) together."""
    top = max((max(pair) for pair in counts.values()), default=0) or 1
    rows = []
    for name, pair in counts.items():
        cells = "".join(
            f'<i style="width:{100 * count / top:.1f}%;background:{COLOURS[side]}"></i>'
            for side, count in zip(COLOURS, pair, strict=False)
        )
        numbers = " / ".join(f"{count:,}" for count in pair)
        rows.append(f"<tr><th>{escape(name)}<td class=bar>{cells}<td class=count>{numbers}")
    return (
        f"<figure><figcaption>{escape(title)}</figcaption><table>{''.join(rows)}</table></figure>"
    )


def _outline(share: NDArray[np.float64], colour: str) -> str:
    """A stepped area; `share` (48,) in [0, 1]."""
    points = [f"{_x(0.0):.1f},{HEIGHT - FOOT}"]
    for k, part in enumerate(share.tolist()):
        y = (HEIGHT - FOOT) - part * (HEIGHT - FOOT - 4)
        points += [f"{_x(k / BINS):.1f},{y:.1f}", f"{_x((k + 1) / BINS):.1f},{y:.1f}"]
    points.append(f"{_x(1.0):.1f},{HEIGHT - FOOT}")
    return f'<polygon points="{" ".join(points)}" fill="{colour}" stroke="{colour}"/>'


def _x(share: float) -> float:
    return LEFT + share * (WIDTH - 2 * LEFT)


def _label(x: float, anchor: str, text: str) -> str:
    return f'<text x="{x:.1f}" y="{HEIGHT - 4}" text-anchor="{anchor}">{text}</text>'


def _figure(title: str, note: str, drawn: str) -> str:
    picture = f'<svg viewBox="0 0 {WIDTH} {HEIGHT}" role="img">{drawn}</svg>' if drawn else ""
    return (
        f"<figure><figcaption>{escape(title)} <small>{escape(note)}</small></figcaption>"
        f"{picture}</figure>"
    )
