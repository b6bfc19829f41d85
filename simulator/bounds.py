"""Checks a caller's numbers, and clips numbers that exceed a bound only by float32 rounding."""

from typing import Any, Final

import numpy as np

from trackfeatures.errors import UserError

ROUNDING: Final = 1e-6
"""Tolerance beyond a bound: absolute for bounds up to 1, relative for larger ones. The spacing of
float32 values at 1 is 1.2e-7."""


def clip_rounding(value: float, low: float, high: float) -> float:
    """Return `value`, or the bound (`low` or `high`) if `value` exceeds it by at most 1e-6 (by 1e-6
    of the bound, if the bound is larger than 1). A value that exceeds a bound by more is returned
    unchanged, so that the caller can refuse it."""
    bound = min(max(value, low), high)
    # The comparison is false for NaN, which is returned unchanged.
    return bound if abs(value - bound) <= ROUNDING * max(1.0, abs(bound)) else value


def check_whole(name: str, value: Any, least: int = 0) -> int:
    """Return `value` as an int. Raises UserError unless it is a whole number >= `least`."""
    whole = isinstance(value, int | np.integer) and not isinstance(value, bool)
    if not whole or value < least:
        raise UserError(f"{name} is {value!r}; give a whole number of {least} or more")
    return int(value)
