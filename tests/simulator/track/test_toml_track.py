"""The project's own tracks: closed loops, distance between parts, class balance, bad files."""

import math
from pathlib import Path

import numpy as np
import pytest

import trackfeatures as tf
from simulator.track.catalogue import OWN_TRACKS, find_track, read_track
from simulator.track.errors import TrackError
from simulator.track.geometry import Track
from simulator.track.layout import Bend, close
from simulator.track.toml_track import LOOKS, Table, read_segments, read_toml_track

NAMES = sorted(path.stem for path in OWN_TRACKS.glob("*.toml"))
TRACKS = {name: find_track(name) for name in NAMES}
OVAL = (OWN_TRACKS / "oval.toml").read_text()


def classes(track: Track) -> np.ndarray:
    """Share of a lap whose heading class is left, straight, right."""
    s = np.arange(0.0, track.length_m, 1.0)
    here, ahead = track.at(s).curvature, track.at(s + tf.LOOK_AHEAD_M).curvature
    found = [tf.classify_heading(float(a), float(b)) for a, b in zip(here, ahead, strict=True)]
    return np.bincount(found, minlength=3) / len(found)


def test_each_of_the_ten_tracks_has_its_own_look() -> None:
    assert len(NAMES) >= 10
    assert {track.look for track in TRACKS.values()} <= set(LOOKS)
    assert len({track.look for track in TRACKS.values()}) == len(TRACKS)
    assert len({track.content_hash for track in TRACKS.values()}) == len(NAMES)


@pytest.mark.parametrize("name", NAMES)
def test_every_track_closes_within_a_millimetre(name: str) -> None:
    track = TRACKS[name]
    before, start = track.at(track.length_m - 1e-6, [5.0, 0.0, -5.0]), track.at(0.0, [5.0, 0.0, -5])
    for axis in ("x", "y", "z"):
        assert np.abs(getattr(before, axis) - getattr(start, axis)).max() < 1e-3
    assert abs(math.remainder(float(before.heading[1] - start.heading[1]), 2 * math.pi)) < 1e-6


@pytest.mark.parametrize("name", NAMES)
def test_segments_have_the_lengths_and_angles_of_the_file(name: str) -> None:
    """Closing the loop changes straights by rounding errors only, and no grades."""
    import tomllib

    path = OWN_TRACKS / f"{name}.toml"
    segments = read_segments(Table(tomllib.loads(path.read_text()), name))
    _, correction = close(segments)
    assert correction < 0.005
    turn = sum(segment.angle for segment in segments if isinstance(segment, Bend))
    assert abs(turn) == pytest.approx(2 * math.pi)


@pytest.mark.parametrize("name", NAMES)
def test_radii_grades_and_widths_are_drivable(name: str) -> None:
    track = TRACKS[name]
    assert 1200.0 <= track.length_m <= 4000.0
    assert track.min_radius_m >= 25.0
    assert max(map(abs, track.grade_range)) <= 0.125
    s = np.arange(0.0, track.length_m, 2.0)
    edges = track.at(s, track.width / 2).z - track.at(s, -track.width / 2).z
    banking = np.degrees(np.arctan(edges / track.width))
    assert np.abs(banking).max() <= 10.0
    # The outer edge is the higher one: right in a left bend.
    assert (banking * track.at(s).curvature <= 1e-12).all()
    # No kinks: the grade changes by at most 4 % over 10 m.
    slopes = np.diff(track.at(s).z) / 2.0
    assert np.abs(slopes[5:] - slopes[:-5]).max() < 0.04
    # A car starts 25 m before the line, on a straight.
    assert (track.at(np.arange(-25.0, 10.0)).curvature == 0.0).all()


@pytest.mark.parametrize("name", NAMES)
def test_parts_of_a_track_do_not_come_near_each_other(name: str) -> None:
    """Parts of the road farther than 100 m along it are at least 45 m apart in the plane."""
    track = TRACKS[name]
    s = np.arange(0.0, track.length_m, 3.0)
    pose = track.at(s)
    apart = np.hypot(pose.x[:, None] - pose.x, pose.y[:, None] - pose.y)
    along = np.abs(s[:, None] - s)
    along = np.minimum(along, track.length_m - along)
    assert apart[along > 100.0].min() >= 45.0


def test_heading_classes_are_balanced_over_all_tracks() -> None:
    shares = np.mean([classes(track) for track in TRACKS.values()], axis=0)
    assert shares.min() >= 0.15
    assert shares.max() <= 0.60
    turns = [math.copysign(1.0, float(np.sum(t.curvature0 * t.length))) for t in TRACKS.values()]
    assert {-1.0, 1.0} == set(turns)


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("radius = 130.0", "radius = 230.0", "to close the loop"),
        ("angle = 90.0", "angle = 88.0", "the segments turn by 358.00 deg in all"),
        ("radius = 130.0", "radius = 2", "expected a number from 8"),
        ("radius = 130.0", 'radius = "wide"', "'wide'"),
        ("radius = 130.0", "radius = nan", "nan"),
        ("radius = 130.0", "raduis = 130.0", "'raduis'"),
        ("spiral = 60.0", "spiral = 400.0", "do not fit"),
        ('look = "oval"', 'look = "moon"', "'moon'"),
        ('type = "straight"', 'type = "loop"', "'loop'"),
        ("line_width = 0.15", "line_width = 1.5", "0.15"),
        ("[[segment]]", "[[segment", "TOML"),
        ("[[segment]]", "[[stretch]]", "'stretch'"),
        ("width = 14.0", "width = true", "True"),
    ],
)
def test_errors_name_the_fault(tmp_path: Path, old: str, new: str, said: str) -> None:
    assert old in OVAL
    path = tmp_path / "bad.toml"
    path.write_text(OVAL.replace(old, new, 1) if old != "[[segment]]" else OVAL.replace(old, new))
    with pytest.raises(TrackError, match=r"bad\.toml") as caught:
        read_track(path)
    assert said in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_square_track_has_the_known_figures(tmp_path: Path) -> None:
    bend = '[[segment]]\ntype = "bend"\nradius = 40\nangle = 90\nspiral = 20\nbanking = 4\n'
    straight = '[[segment]]\ntype = "straight"\nlength = 100\n'
    path = tmp_path / "square.toml"
    path.write_text('look = "town"\nwidth = 8.0\n' + (straight + bend) * 4)
    track = read_toml_track(path)
    assert track.length_m == pytest.approx(4 * (100.0 + 20.0 * math.pi + 20.0))
    assert track.min_radius_m == pytest.approx(40.0)
    middle = 100.0 + (20.0 * math.pi + 20.0) / 2
    right, left = track.at(middle, [-4.0, 4.0]).z
    assert right - left == pytest.approx(8.0 * math.tan(math.radians(4.0)))
    # Half-way along the spiral the curvature and the banking are half of the bend's.
    assert float(track.at(110.0 + 1e-6).curvature) == pytest.approx(1 / 80.0, rel=0.11)
    half = track.at(110.0, [-4.0, 4.0]).z
    assert half[0] - half[1] == pytest.approx(4.0 * math.tan(math.radians(4.0)), rel=0.01)


@pytest.mark.parametrize("text", ["width = " + "9" * 5000, "width = " + "[" * 5000])
def test_unparsable_toml_is_refused(tmp_path: Path, text: str) -> None:
    path = tmp_path / "deep.toml"
    path.write_text(text)
    with pytest.raises(TrackError, match=r"deep\.toml: not a readable TOML file"):
        read_track(path)


def test_a_straight_left_without_length_is_refused(tmp_path: Path) -> None:
    bend = '[[segment]]\ntype = "bend"\nradius = 40\nangle = 90\n'

    def straight(length: float) -> str:
        return f'[[segment]]\ntype = "straight"\nlength = {length}\n'

    # 1.2 m too long one way, shared by three straights: 0.4 m off one of 0.1 m.
    sides = straight(0.1) + straight(50.0) + bend, straight(30.0) + bend, straight(48.9) + bend
    path = tmp_path / "short.toml"
    path.write_text('look = "town"\nwidth = 8.0\n' + "".join(sides) + straight(30.0) + bend)
    with pytest.raises(TrackError, match=r"short\.toml: closing the loop leaves a straight no"):
        read_toml_track(path)


def test_error_for_a_track_without_straights_names_its_file(tmp_path: Path) -> None:
    bend = '[[segment]]\ntype = "bend"\nradius = 40\nangle = 120\n'
    path = tmp_path / "round.toml"
    path.write_text('look = "town"\nwidth = 8.0\n' + bend * 3)
    with pytest.raises(TrackError, match=r"round\.toml: straights in two directions"):
        read_toml_track(path)


def test_a_vertical_curve_longer_than_the_lap_is_refused(tmp_path: Path) -> None:
    straight = '[[segment]]\ntype = "straight"\nlength = 10.0\n'
    bend = '[[segment]]\ntype = "bend"\nradius = 12.0\nangle = 90.0\n'
    path = tmp_path / "small.toml"
    lap = 4 * 10.0 + 2 * math.pi * 12.0
    for curve in (lap - 0.1, lap + 0.1):
        head = f'look = "town"\nwidth = 9.0\nvertical_curve = {curve}\n'
        path.write_text(head + 4 * (straight + bend))
        if curve < lap:
            assert read_track(path).length_m == pytest.approx(lap)
    with pytest.raises(TrackError, match=r"vertical_curve 115\.\d+ m is longer than the lap"):
        read_track(path)
