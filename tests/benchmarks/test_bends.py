"""The table of the benchmark of bends."""

from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest

from benchmarks.bends import CLAIM, MIN_POSES, first_visible_m, hidden_turn, table
from simulator.track.road import Road
from trackfeatures.camera import CameraParameters


def test_errors_are_sorted_by_radius_and_change() -> None:
    radius = np.repeat([1000.0, 40.0, -40.0, 20.0], MIN_POSES)
    error = np.repeat([0.001, 0.005, 0.005, 0.011], MIN_POSES)
    steady = np.repeat([True, True, True, False], MIN_POSES)
    error[-1] = 0.031  # the mean is 0.012
    steady[0] = False  # a single pose decides nothing
    rows = {
        (row["radius"], row["kind"]): row for row in table(error, 1 / radius, steady, error / 2)
    }
    assert list(rows) == [(name, kind) for name in CLAIM for kind in ("steady", "change")]
    straight = rows["over 300 m", "steady"]
    assert (straight["poses"], straight["mean_rad"], straight["reached"]) == (19, 0.001, None)
    # The errors in left and right bends have the same sign, so there is no bias along the bend.
    both = rows["25 to 50 m", "steady"]
    assert (both["poses"], both["mean_rad"], both["bias_rad"]) == (40, 0.005, 0.0)
    assert (both["visible_rad"], both["reached"]) == (0.0025, True)
    # The mean error is within the claim, the bias is above a third of it.
    biased = rows["under 25 m", "change"]
    assert (biased["mean_rad"], biased["bias_rad"], biased["reached"]) == (0.012, 0.012, False)
    assert "mean_rad" not in rows["50 to 100 m", "steady"]


def test_the_road_below_the_car_is_unknown_where_the_curvature_changes() -> None:
    hidden_m = first_visible_m(CameraParameters())
    assert hidden_m == pytest.approx(2.546, abs=0.001)
    track = SimpleNamespace(length_m=100.0, curvature=lambda s: 0.05 if 20.0 <= s < 60.0 else 0.0)
    road = cast(Road, SimpleNamespace(track=track))
    assert hidden_turn(road, 25.0, hidden_m) == pytest.approx(0.0, abs=1e-9)
    # The bend begins halfway between the car and the first visible point.
    half = 0.05 * hidden_m / 2
    assert hidden_turn(road, 20.0 - hidden_m / 2, hidden_m) == pytest.approx(half, rel=0.05)
    assert hidden_turn(road, 60.0 - hidden_m / 2, hidden_m) == pytest.approx(-half, rel=0.05)
