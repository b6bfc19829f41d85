"""The TORCS importer on small hand-written files with results computed by hand."""

import math
from pathlib import Path

import numpy as np
import pytest

from simulator.track.geometry import Track
from simulator.track.torcs.torcs import read_torcs

FIXTURES = Path(__file__).parents[1] / "fixtures"
HALF_TURN = 50.0 * math.pi
"""Length of the stadium's bends, m; its straights are 100 m long."""


def read(name: str) -> Track:
    return read_torcs(FIXTURES / f"{name}.xml")


def z(track: Track, s: float, y: float = 0.0) -> float:
    return float(track.at(s, y).z)


def test_end_radius_turns_by_the_arc_in_equal_steps() -> None:
    track = read("end-radius")
    radii = [40.0, 160.0 / 3.0, 200.0 / 3.0, 80.0]
    step = (math.pi / 2) / sum(1.0 / r for r in radii)
    assert step == pytest.approx(22.0463, abs=1e-4)
    spiral = track.length[1:5]
    assert spiral == pytest.approx([step] * 4)
    assert 1.0 / track.curvature0[1:9] == pytest.approx(radii + radii[::-1])
    assert track.length_m == pytest.approx(200.0 + 16 * step)
    assert track.min_radius_m == pytest.approx(40.0)
    # A quarter turn each.
    assert track.heading(100.0 + 4 * step) == pytest.approx(math.pi / 2)


def test_the_start_is_at_the_right_edge_heading_along_x() -> None:
    pose = read("end-radius").at(0.0)
    assert (float(pose.x), float(pose.y), float(pose.heading)) == pytest.approx((0.0, 5.0, 0.0))


def test_a_grade_holds_until_another_height_is_given() -> None:
    track = read("sticky-grade")
    top = 5.0 + 0.05 * HALF_TURN
    assert top == pytest.approx(12.85398)
    assert z(track, 50.0) == pytest.approx(2.5)
    assert z(track, 100.0) == pytest.approx(5.0)
    assert z(track, 100.0 + HALF_TURN) == pytest.approx(top)
    assert z(track, 200.0 + HALF_TURN) == pytest.approx(top - 10.0)
    assert track.z_range_m == pytest.approx(top)
    assert track.slope(60.0) == pytest.approx(0.05)
    assert track.grade_range == pytest.approx((-0.10, 0.05))


def test_banking_lifts_the_left_edge_and_holds_for_later_segments() -> None:
    track = read("banking")
    rise = math.tan(math.radians(8.0)) * 5.0
    assert rise == pytest.approx(0.70270, abs=1e-5)
    assert z(track, 50.0, 5.0) == pytest.approx(rise / 2)
    for s in (100.0, 100.0 + HALF_TURN / 2, 100.0 + HALF_TURN):
        assert z(track, s, 5.0) == pytest.approx(rise)
        assert z(track, s, -5.0) == pytest.approx(-rise)
        # The banking plane continues beyond the width.
        assert z(track, s, -10.0) == pytest.approx(-2 * rise)
    assert z(track, 200.0 + 1.5 * HALF_TURN, 5.0) == pytest.approx(0.0, abs=1e-12)
    assert track.z_range_m == pytest.approx(0.0, abs=1e-12)
    assert track.curvature(150.0) == pytest.approx(-1.0 / 50.0)


def test_heights_may_be_given_by_edge_or_centre() -> None:
    track = read("both-heights")
    assert z(track, 100.0) == pytest.approx(2.0)
    assert z(track, 99.999999, 5.0) == pytest.approx(3.0, abs=1e-6)
    assert z(track, 100.0 + HALF_TURN / 2, 5.0) == pytest.approx(2.5)
    assert z(track, 100.0 + HALF_TURN / 2, -5.0) == pytest.approx(1.0)
    back = 100.0 + HALF_TURN
    assert z(track, back + 50.0, 5.0) == pytest.approx((1.5 + 4.0) / 2)
    assert z(track, back + 99.999999, -5.0) == pytest.approx(4.0, abs=1e-6)
    assert z(track, back + 100.0 + HALF_TURN / 2) == pytest.approx(2.0)


def test_spline_profile_passes_through_the_cubic() -> None:
    track = read("spline")
    for s, height in ((25.0, 0.15625), (50.0, 0.75), (75.0, 1.96875), (100.0, 4.0)):
        assert z(track, s) == pytest.approx(height)
    # The bend starts with the 10 % the straight ended with: 4 + 0.125 * 0.1 * L half-way.
    assert z(track, 100.0 + HALF_TURN / 2) == pytest.approx(4.0 + 0.0125 * HALF_TURN)
    fall = 100.0 + HALF_TURN
    # 30 m steps: int(100 / 30) + 1 = 4 of 25 m; level tangents are carried on.
    assert z(track, fall + 25.0) == pytest.approx(3.375)
    assert z(track, fall + 50.0) == pytest.approx(2.0)
    # Misspelt `profile steps` leave one step, which is cut into two quarter turns.
    assert int(np.sum(track.s0 > fall + 100.0 - 1e-6)) == 2


def test_version_3_files_in_feet_and_latin_1_are_read() -> None:
    track = read("version-3")
    straight = 304.801
    assert track.length_m == pytest.approx(2 * straight + 200.0 * math.pi)
    assert track.length[:7] == pytest.approx([straight / 7] * 7)
    assert len(track.s0) == 28
    assert track.width == 20.0
    assert track.min_radius_m == pytest.approx(100.0)
    assert (track.name, track.source, track.look) == ("version-3", "torcs", "oval")
