"""Bounds of the numbers that a caller gives, with room for the rounding of float32."""

from typing import Final

ROUNDING: Final = 1e-6
"""Room beyond a bound: absolute up to 1, relative beyond. The spacing of float32 is 1.2e-7 at 1."""


def clip_rounding(value: float, low: float, high: float) -> float:
    """`value`, or the bound that it exceeds by no more than ROUNDING."""
    bound = min(max(value, low), high)
    # False for NaN.
    return bound if abs(value - bound) <= ROUNDING * max(1.0, abs(bound)) else value
