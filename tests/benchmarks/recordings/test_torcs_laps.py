"""Flying laps of the real TORCS, driven again with the same control law: within the limits."""

import os
from pathlib import Path

import numpy as np
import pytest

from benchmarks.recordings.torcs_laps import (
    LIMITS,
    TRACKS,
    Fit,
    Lap,
    compare,
    figures,
    read_recording,
)
from trackfeatures import UserError

FOLDER = Path(os.environ.get("TORCS_TRACKS") or "nowhere") / "drives"
recorded = pytest.mark.skipif(
    not FOLDER.is_dir(), reason="TORCS_TRACKS names no folder with drives/ of the real program"
)


@recorded
@pytest.mark.slow
@pytest.mark.parametrize(
    "as_recorded",
    [pytest.param(True, marks=pytest.mark.extended), False],
    ids=["as-recorded", "every-50-ms"],
)
@pytest.mark.parametrize("track", TRACKS)
def test_the_flying_lap_equals_that_of_torcs_within_the_limits(
    track: str, as_recorded: bool
) -> None:
    fit = compare(track, FOLDER, as_recorded=as_recorded)
    assert all(fit.within.values()), fit.difference
    assert fit.here.least_speed_kmh == pytest.approx(fit.torcs.least_speed_kmh, abs=1.0)
    assert fit.here.most_speed_kmh == pytest.approx(fit.torcs.most_speed_kmh, abs=1.0)


@recorded
@pytest.mark.parametrize(
    ("track", "steps", "score", "mean_d", "max_d"),
    [("forza", 6281, 0.9966, 0.009, 0.369), ("g-track-3", 3118, 0.9896, 0.026, 0.161)],
)
def test_the_figures_of_the_reference_laps(
    track: str, steps: int, score: float, mean_d: float, max_d: float
) -> None:
    rows = read_recording(FOLDER / f"{track}-lqr.csv")
    lap = figures(rows[rows["lap"] == 2], {"forza": 5.5, "g-track-3": 5.0}[track])
    assert lap.steps == steps
    assert lap.score_per_step == pytest.approx(score, abs=1e-4)
    assert lap.mean_abs_d_m == pytest.approx(mean_d, abs=6e-4)
    assert lap.max_abs_d_m == pytest.approx(max_d, abs=6e-4)


def test_a_lap_outside_the_limits_is_missed() -> None:
    torcs = Lap(1000, 0.99, 0.01, 0.2, 50.0, 70.0)
    worse = Lap(1011, 0.985, 0.04, 0.36, 50.0, 70.0)
    assert not any(Fit("forza", worse, torcs).within.values())
    near = Lap(1009, 0.987, 0.02, 0.34, 50.0, 70.0)
    assert all(Fit("forza", near, torcs).within.values())
    assert Fit("forza", near, torcs).difference["steps"] == pytest.approx(0.009)
    assert set(Fit("forza", near, torcs).within) == set(LIMITS)


def test_figures_of_a_lap() -> None:
    rows = np.array(
        [(0.5, 0.0, 10.0), (-1.5, 0.1, 20.0)], dtype=[("d", "f8"), ("th", "f8"), ("v", "f8")]
    )
    lap = figures(rows, 5.0)
    assert (lap.steps, lap.mean_abs_d_m, lap.max_abs_d_m) == (2, 1.0, 1.5)
    scores = [1.0 - 0.1, np.cos(0.1) - np.sin(0.1) - 0.3]
    assert lap.score_per_step == pytest.approx(np.mean(scores))
    assert (lap.least_speed_kmh, lap.most_speed_kmh) == (36.0, 72.0)


def test_a_missing_recording_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="no recorded laps at"):
        read_recording(tmp_path / "forza-lqr.csv")
