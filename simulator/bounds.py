"""Checks a caller's numbers; clips one that exceeds its bound only by the rounding of float32."""

from typing import Any, Final

import numpy as np

from trackfeatures.errors import UserError

ROUNDING: Final = 1e-6
"""Tolerance beyond a bound: absolute up to 1, relative beyond. float32 is spaced 1.2e-7 at 1."""


def clip_rounding(value: float, low: float, high: float) -> float:
    """`value`, or the bound that `value` exceeds by at most ROUNDING."""
    bound = min(max(value, low), high)
    # The comparison is false for NaN, which is returned unchanged.
    return bound if abs(value - bound) <= ROUNDING * max(1.0, abs(bound)) else value


def check_whole(name: str, value: Any, least: int = 0) -> int:
    """`value` as an int. Raises UserError unless it is a whole number of at least `least`."""
    whole = isinstance(value, int | np.integer) and not isinstance(value, bool)
    if not whole or value < least:
        raise UserError(f"{name} is {value!r}; give a whole number of {least} or more")
    return int(value)
