"""Axes of charts: where a value lies, and the round numbers beside it; linear or logarithmic."""

import math
from collections.abc import Iterable
from dataclasses import dataclass

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
