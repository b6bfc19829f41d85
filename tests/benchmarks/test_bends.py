"""The table of the benchmark of bends."""

import numpy as np

from benchmarks.bends import CLAIM, MIN_POSES, table


def test_errors_are_sorted_by_radius_and_change() -> None:
    radius = np.repeat([1000.0, 40.0, -40.0, 20.0], MIN_POSES)
    error = np.repeat([0.001, 0.005, 0.005, 0.011], MIN_POSES)
    steady = np.repeat([True, True, True, False], MIN_POSES)
    error[-1] = 0.031  # the mean is 0.012
    steady[0] = False  # a single pose decides nothing
    rows = {(row["radius"], row["kind"]): row for row in table(error, 1 / radius, steady)}
    assert list(rows) == [(name, kind) for name in CLAIM for kind in ("steady", "change")]
    straight = rows["over 300 m", "steady"]
    assert (straight["poses"], straight["mean_rad"], straight["reached"]) == (19, 0.001, None)
    # The errors in left and right bends have the same sign, so there is no bias along the bend.
    both = rows["25 to 50 m", "steady"]
    assert (both["poses"], both["mean_rad"], both["bias_rad"]) == (40, 0.005, 0.0)
    assert both["reached"] is True
    # The mean error is within the claim, the bias is above a third of it.
    biased = rows["under 25 m", "change"]
    assert (biased["mean_rad"], biased["bias_rad"], biased["reached"]) == (0.012, 0.012, False)
    assert "mean_rad" not in rows["50 to 100 m", "steady"]
