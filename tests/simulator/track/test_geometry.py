"""Track geometry in closed form, and projection against a brute-force search."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

import trackfeatures as tf
from simulator.track import piece_table
from simulator.track.catalogue import find_track
from simulator.track.geometry import Track, wrap_angle
from simulator.track.markings import MarkingStyle
from simulator.track.pieces import Piece, assemble
from simulator.track.road import Road
from tests.simulator.track.track_samples import figure_of_eight, stadium

STADIUM, EIGHT = stadium(), figure_of_eight()
MOUNTAIN = find_track("mountain-pass")
LAP = 200.0 + 100.0 * math.pi


def apart(track: Track, a: float, b: float) -> float:
    """Distance of two s round the lap."""
    return abs((a - b + track.length_m / 2) % track.length_m - track.length_m / 2)


def test_stadium_matches_its_closed_form() -> None:
    assert STADIUM.length_m == pytest.approx(LAP)
    assert STADIUM.min_radius_m == pytest.approx(50.0)
    assert STADIUM.z_range_m == pytest.approx(6.0)
    pose = STADIUM.at(100.0 + 25.0 * math.pi, [0.0, 10.0, -5.0])
    assert pose.x == pytest.approx([150.0, 140.0, 155.0])
    assert pose.y == pytest.approx([50.0] * 3)
    # Half-way round: left edge 4, right edge 5, and the plane goes on beyond the width.
    assert pose.z == pytest.approx([4.5, 3.5, 5.0])
    assert pose.heading == pytest.approx([math.pi / 2] * 3)
    assert pose.curvature == pytest.approx([0.02] * 3)
    assert STADIUM.slope(10.0) == pytest.approx(0.03)
    # s wraps, both ways.
    assert float(STADIUM.at(LAP + 30.0).x) == pytest.approx(30.0)
    assert float(STADIUM.at(-10.0).heading) == pytest.approx(-0.2)


@pytest.mark.parametrize("hint", [0, 4])
def test_a_point_in_the_closing_gap_has_the_height_of_the_line(hint: int) -> None:
    """The last piece falls 6 m to the line; the closing gap of an imported track is 0.15 m long."""
    bend, straight = math.pi * 60.0, 100.0
    pieces = [
        *(Piece(straight, 0, 0, 0, 0, 0), Piece(bend, 1 / 60, 0, 0, 6, 6)),
        *(Piece(2 * straight, 0, 6, 6, 6, 6), Piece(bend, 1 / 60, 6, 6, 6, 6)),
        Piece(straight - 0.15, 0, 6, 6, 0, 0),
    ]
    track = Track.from_placed(
        assemble(pieces), name="gap", source="torcs", width=11.0, surface="asphalt",
        look="circuit", markings=MarkingStyle(),
    )  # fmt: skip
    table = track.arrays()
    index, s, to_middle = piece_table.locate(table, -0.05, 0.5, hint)
    assert piece_table.surface(table, index, s, to_middle)[0] == pytest.approx(0.0, abs=0.01)
    assert s == pytest.approx(0.0, abs=0.1)
    assert to_middle == pytest.approx(0.5)


def test_wrap_angle_keeps_pi() -> None:
    assert wrap_angle(np.array([math.pi, -math.pi, 3 * math.pi, 0.0])) == pytest.approx(
        [math.pi, math.pi, math.pi, 0.0]
    )


@settings(max_examples=200, deadline=None)
@given(
    share=st.floats(0.0, 1.0, exclude_max=True),
    y=st.floats(-20.0, 20.0),
    wrong_by=st.floats(-60.0, 60.0),
    name=st.sampled_from(["stadium", "mountain-pass"]),
)
@example(share=1e-9, y=-4.0, wrong_by=0.0, name="mountain-pass")
def test_project_inverts_at(share: float, y: float, wrong_by: float, name: str) -> None:
    """At the closing joint, a kink of up to 1e-6 rad, both pieces are correct answers."""
    limit = 1e-6 * (1.0 + abs(y))
    track = STADIUM if name == "stadium" else MOUNTAIN
    s = share * track.length_m
    pose = track.at(s, y)
    for hint in (None, s + wrong_by):
        found, to_middle = track.project(float(pose.x), float(pose.y), hint)
        assert apart(track, found, s) < limit
        assert to_middle == pytest.approx(y, abs=1e-6)


@settings(max_examples=100, deadline=None)
@given(x=st.floats(-300.0, 600.0), y=st.floats(-150.0, 600.0))
def test_projection_finds_the_nearest_point(x: float, y: float) -> None:
    """No sampled point of the lap is nearer than the projection, even in hairpins and far off."""
    s = np.arange(0.0, MOUNTAIN.length_m, 0.25)
    pose = MOUNTAIN.at(s)
    brute = float(np.hypot(pose.x - x, pose.y - y).min())
    found, to_middle = MOUNTAIN.project(x, y)
    foot = MOUNTAIN.at(found)
    distance = math.hypot(float(foot.x) - x, float(foot.y) - y)
    assert distance <= brute + 1e-9
    assert brute - distance < 0.13
    assert abs(to_middle) == pytest.approx(distance, abs=1e-4)


def test_a_hint_distinguishes_a_bridge_from_the_road_below() -> None:
    lap = EIGHT.length_m
    end = EIGHT.at(lap - 1e-9)
    assert (float(end.x), float(end.y)) == pytest.approx((0.0, 0.0), abs=1e-6)
    for s in np.concatenate((np.linspace(-20.0, 20.0, 41), lap / 2 + np.linspace(-20, 20, 41))):
        pose = EIGHT.at(float(s), 0.3)
        found, to_middle = EIGHT.project(float(pose.x), float(pose.y), float(s) - 1.0)
        assert apart(EIGHT, found, float(s)) < 1e-6
        assert to_middle == pytest.approx(0.3)
        height = 0.0 if abs(s) < 21.0 else 6.0
        assert float(EIGHT.at(found, to_middle).z) == pytest.approx(height)


def test_a_wrong_hint_is_corrected() -> None:
    pose = MOUNTAIN.at(1500.0, 1.0)
    for hint in (0.0, 400.0, 900.0, 2400.0):
        found, to_middle = MOUNTAIN.project(float(pose.x), float(pose.y), hint)
        assert (found, to_middle) == pytest.approx((1500.0, 1.0))


@pytest.mark.parametrize("s", [3.0, 150.0, 250.0, 330.0, 500.0])
@pytest.mark.parametrize("y", [-4.0, 0.0, 6.0])
def test_surface_normal_equals_that_of_nearby_points(s: float, y: float) -> None:
    table = STADIUM.arrays()
    index = piece_table.index_at(table, s)
    z, *normal = piece_table.surface(table, index, s, y)
    assert z == pytest.approx(float(STADIUM.at(s, y).z))
    a, b = STADIUM.at([s - 1e-4, s + 1e-4], y), STADIUM.at(s, [y - 1e-4, y + 1e-4])
    along = np.array([np.diff(a.x)[0], np.diff(a.y)[0], np.diff(a.z)[0]])
    across = np.array([np.diff(b.x)[0], np.diff(b.y)[0], np.diff(b.z)[0]])
    expected = np.cross(along, across)
    assert normal == pytest.approx(expected / np.linalg.norm(expected), abs=1e-6)


def test_compiled_pose_equals_the_vectorised_one() -> None:
    for s in (-5.0, 0.0, 77.7, 1234.5, MOUNTAIN.length_m, 3000.0):
        x, y, z, heading, curvature = piece_table.pose_at(MOUNTAIN.arrays(), s)
        pose = MOUNTAIN.at(s)
        assert [x, y, z] == pytest.approx([float(pose.x), float(pose.y), float(pose.z)])
        assert float(wrap_angle(np.float64(heading))) == pytest.approx(float(pose.heading))
        assert curvature == MOUNTAIN.curvature(s) == float(pose.curvature)
        assert MOUNTAIN.heading(s) == pytest.approx(float(pose.heading))


def test_equal_geometry_has_an_equal_content_hash() -> None:
    assert stadium().content_hash == STADIUM.content_hash
    assert len(STADIUM.content_hash) == 64
    assert EIGHT.content_hash != STADIUM.content_hash


def test_surface_scenery_and_paint_change_the_hash_of_pictures() -> None:
    painted = replace(STADIUM.markings, kerbs=not STADIUM.markings.kerbs)
    tracks = [
        STADIUM,
        EIGHT,
        replace(STADIUM, surface="gravel"),
        replace(STADIUM, look="coast"),
        replace(STADIUM, markings=painted),
    ]
    assert len({track.picture_hash for track in tracks}) == 5
    assert replace(STADIUM, name="other").picture_hash == STADIUM.picture_hash


def test_road_widths_and_marking_offsets() -> None:
    narrow, wide = Road(STADIUM), Road(STADIUM, lanes=3)
    assert (narrow.half_width, narrow.half_asphalt, narrow.edge) == (5.0, 3.0, 5.0)
    assert (wide.half_width, wide.half_asphalt, wide.edge, wide.wall_offset) == (5.0, 7.0, 7.0, 9.5)
    assert wide.markings_y == pytest.approx([6.0, 2.0, -2.0, -6.0])
    features = narrow.measure(85.0, 0.5, 0.1)
    assert (features.ml, features.mr) == pytest.approx((-1.5, 2.5))
    # Straight here, but the bend begins within 20 m.
    assert features.heading is tf.RoadClass.LEFT
    by_pose = tf.measure_pose(STADIUM, 85.0, 0.5, -0.1, 1, 4.0)
    assert (by_pose.ml, by_pose.mr, by_pose.heading) == (features.ml, features.mr, features.heading)
    assert by_pose.angle == pytest.approx(features.angle)
    with pytest.raises(tf.UserError, match="4 lanes"):
        Road(STADIUM, lanes=4)
