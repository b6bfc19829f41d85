"""Imported tracks equal reference data of TORCS 1.3.7; needs $TORCS_TRACKS (see README)."""

import csv
import os
from pathlib import Path

import numpy as np
import pytest

from simulator.track.catalogue import find_track


def _reference_folder() -> Path:
    """The folder above `tracks`, with `reference.csv` and `centreline` in it, or a skip."""
    folder = Path(os.environ.get("TORCS_TRACKS", ""))
    for candidate in (folder, folder.parent):
        if (candidate / "reference.csv").is_file():
            return candidate
    pytest.skip("$TORCS_TRACKS names no folder with reference.csv beside the tracks")


def test_dimensions_equal_the_reference() -> None:
    folder = _reference_folder()
    rows = list(csv.DictReader((folder / "reference.csv").open()))
    assert len(rows) >= 13
    for row in rows:
        track = find_track(row["track"], folder)
        expected = {name: float(value) for name, value in row.items() if name != "track"}
        assert track.length_m == pytest.approx(expected["length_m"], rel=1e-4), row
        assert track.width == pytest.approx(expected["width_m"]), row
        assert track.min_radius_m == pytest.approx(expected["min_radius_m"], rel=1e-3), row
        assert track.z_range_m == pytest.approx(expected["z_range_m"], abs=0.02), row
        fall, rise = track.grade_range
        assert 100 * rise == pytest.approx(expected["grade_max_pct"], abs=0.1), row
        assert 100 * fall == pytest.approx(expected["grade_min_pct"], abs=0.1), row


@pytest.mark.parametrize("name", ["forza", "g-track-3"])
@pytest.mark.parametrize("edge", [0.0, 0.5, -0.5])
def test_centre_line_and_edges_equal_the_reference(name: str, edge: float) -> None:
    folder = _reference_folder()
    points = np.genfromtxt(folder / "centreline" / f"{name}.csv", delimiter=",", names=True)
    track = find_track(name, folder)
    suffix = {0.0: "", 0.5: "l", -0.5: "r"}[edge]
    theirs = np.column_stack([points[axis + suffix] for axis in "xyz"])
    pose = track.at(points["s"], edge * track.width)
    ours = np.column_stack([pose.x, pose.y, pose.z])
    # The program shifts its world: both centre lines start at the origin.
    start = track.at(0.0)
    theirs -= [points[axis][0] for axis in "xyz"]
    ours -= [float(start.x), float(start.y), float(start.z)]
    assert np.abs(np.hypot(*(ours - theirs)[:, :2].T)).max() < 0.02
    assert np.abs(ours - theirs)[:, 2].max() < 0.02
    turned = np.angle(np.exp(1j * (pose.heading - points["ang"])))
    assert np.abs(turned).max() < 1e-4
