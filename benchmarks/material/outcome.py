"""How a benchmark ends: its claim is reached, missed, or could not be measured.

The exit codes are read by `make bench`, which lists missed and unmeasured benchmarks separately.
"""

import sys

REACHED, MISSED, NOT_MEASURED = 0, 1, 3


def exit_code(reached: bool) -> int:
    """The exit code of a benchmark that measured its claim."""
    return REACHED if reached else MISSED


def not_measured(reason: str) -> int:
    """Write why the claim was not measured and what is needed for it; the exit code."""
    sys.stderr.write(f"not measured: {reason}\n")
    return NOT_MEASURED
