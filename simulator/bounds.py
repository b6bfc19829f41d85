"""Clips a caller's number that exceeds its bound only by the rounding of float32."""

from typing import Final

ROUNDING: Final = 1e-6
"""Tolerance beyond a bound: absolute up to 1, relative beyond. float32 is spaced 1.2e-7 at 1."""


def clip_rounding(value: float, low: float, high: float) -> float:
    """`value`, or the bound that `value` exceeds by at most ROUNDING."""
    bound = min(max(value, low), high)
    # The comparison is false for NaN, which is returned unchanged.
    return bound if abs(value - bound) <= ROUNDING * max(1.0, abs(bound)) else value
