"""Centre lines as CSV in the format of the TUM racetrack database: reading, writing, bad files."""

import math
from pathlib import Path

import numpy as np
import pytest

from simulator.track.catalogue import find_track, read_track
from simulator.track.centre_line_csv import survey_noise, write_centre_line
from simulator.track.errors import TrackError

HEADER = "# x_m,y_m,w_tr_right_m,w_tr_left_m\n"


def circle(radius: float = 80.0, count: int = 100) -> list[str]:
    turns = np.linspace(0.0, 2 * math.pi, count, endpoint=False)
    return [f"{radius * math.cos(t):.6f},{radius * math.sin(t):.6f},5.5,6.0" for t in turns]


@pytest.mark.parametrize("repeat_first", [False, True])
def test_points_of_a_circle_give_its_radius_and_length(tmp_path: Path, repeat_first: bool) -> None:
    path = tmp_path / "ring.csv"
    points = circle()
    path.write_text(HEADER + "\n".join(points + points[:1] * repeat_first) + "\n")
    track = read_track(path)
    assert (track.name, track.source, track.width) == ("ring", "csv", 11.5)
    assert track.length_m == pytest.approx(2 * math.pi * 80.0, abs=0.5)
    assert track.curvature0 == pytest.approx(np.full(len(track.s0), 1 / 80.0), rel=0.08)
    assert np.std(track.curvature0) < 0.03 / 80.0
    assert track.z_range_m == 0.0


def test_a_track_in_the_coordinates_of_a_map_is_moved_to_the_origin(tmp_path: Path) -> None:
    """Graphics and contacts compute in float32."""
    ring = np.array([row.split(",") for row in circle()], float)
    tracks = []
    for x, y in ((0.0, 0.0), (691_000.0, 5_335_000.0), (9_000.0, -9_000.0)):
        path = tmp_path / "ring.csv"
        np.savetxt(path, ring + np.array([x, y, 0.0, 0.0]), "%.6f", ",")
        tracks.append(read_track(path))
    here, there, near = tracks
    for found, expected in ((there.x0, here.x0), (there.y0, here.y0)):
        np.testing.assert_allclose(found, expected, atol=1e-5)
    assert (near.x0[0] - here.x0[0], near.y0[0] - here.y0[0]) == pytest.approx((9e3, -9e3))


@pytest.mark.parametrize("name", ["circuit", "coast"])
def test_a_sampled_track_round_trips(tmp_path: Path, name: str) -> None:
    """A track sampled every 5 m with 2 cm of noise is read back within 0.25 m."""
    track = find_track(name)
    s = np.linspace(0.0, track.length_m, int(track.length_m / 5), endpoint=False)
    pose = track.at(s)
    rng = np.random.default_rng(3)
    x, y = (axis + rng.normal(0.0, 0.02, len(s)) for axis in (pose.x, pose.y))
    rows = [f"{a:.4f},{b:.4f},5.0,5.0" for a, b in zip(x, y, strict=True)]
    path = tmp_path / "survey.csv"
    path.write_text(HEADER + "\n".join(rows))
    survey = read_track(path)
    assert survey.length_m == pytest.approx(track.length_m, rel=1e-3)
    offsets = [survey.project(float(a), float(b))[1] for a, b in zip(pose.x, pose.y, strict=True)]
    assert np.abs(offsets).max() < 0.25
    end = survey.at(survey.length_m - 1e-6)
    assert math.hypot(float(end.x - survey.x0[0]), float(end.y - survey.y0[0])) < 1e-3


@pytest.mark.parametrize("noise", [0.1, 0.2])
@pytest.mark.parametrize("spacing", [2.0, 5.0])
def test_smoothing_adapts_to_the_estimated_noise(
    tmp_path: Path, noise: float, spacing: float
) -> None:
    """Unevenly spaced points and widths with 0.1 or 0.2 m of noise still give the original road."""
    track = find_track("coast")
    count = int(track.length_m / spacing)
    rng = np.random.default_rng([7, int(10 * noise), int(spacing)])
    s = (np.arange(count) + rng.uniform(-0.3, 0.3, count)) * track.length_m / count
    pose = track.at(s)
    points = np.column_stack((pose.x, pose.y)) + rng.normal(0.0, noise, (count, 2))
    assert survey_noise(points) == pytest.approx(noise, rel=0.15)
    rows = np.column_stack((points, 5.0 + rng.normal(0.0, 0.1, (count, 2))))
    path = tmp_path / "survey.csv"
    np.savetxt(path, rows, "%.6f", ",", header="x_m,y_m,w_tr_right_m,w_tr_left_m")
    survey = read_track(path)
    assert survey.length_m == pytest.approx(track.length_m, rel=5e-4)
    assert survey.width == pytest.approx(10.0, abs=0.05)
    assert survey.min_radius_m > 0.75 * track.min_radius_m
    every = track.at(np.arange(0.0, track.length_m, 5.0))
    offsets = [survey.project(float(a), float(b))[1] for a, b in zip(every.x, every.y, strict=True)]
    assert np.abs(offsets).max() < 3.0 * noise


def test_written_rows_equal_the_track(tmp_path: Path) -> None:
    track = find_track("mountain-pass")
    path = tmp_path / "line.csv"
    rows = write_centre_line(track, 2.5, path)
    assert path.read_text().splitlines()[0] == "s,x,y,z,ang,curv"
    table = np.genfromtxt(path, delimiter=",", names=True)
    assert len(table) == rows == math.ceil(track.length_m / 2.5)
    pose = track.at(table["s"])
    for column, values in zip(
        ("x", "y", "z", "ang", "curv"),
        (pose.x, pose.y, pose.z, pose.heading, pose.curvature),
        strict=True,
    ):
        assert table[column] == pytest.approx(values, abs=1e-6)
    assert [p.name for p in tmp_path.iterdir()] == ["line.csv"]


@pytest.mark.parametrize(
    ("lines", "said"),
    [
        ([], "0 points"),
        (circle()[:5], "5 points"),
        ([*circle(), "1,2,3"], "line 102"),
        ([*circle(), "1,2,nan,4"], "line 102"),
        ([*circle(), "a,b,c,d"], "line 102"),
        (["1e200,0,5,5", *circle()], "line 2 is '1e200,0,5,5', a point more than 1e+07 m"),
        (["3,4,5,5"] * 50, "different points"),
        (circle()[:50], "from the first"),
        (circle(radius=2.0), "12.6 m"),
        ([line.replace("5.5,6.0", "-5.5,6.0") for line in circle()], "widths"),
        ([line.replace("5.5,6.0", "55,60") for line in circle()], "widths"),
    ],
)
def test_errors_name_the_fault(tmp_path: Path, lines: list[str], said: str) -> None:
    path = tmp_path / "bad.csv"
    path.write_text(HEADER + "\n".join(lines))
    with pytest.raises(TrackError, match=r"bad\.csv") as caught:
        read_track(path)
    assert said in str(caught.value)


def test_a_width_of_zero_to_one_side_is_named(tmp_path: Path) -> None:
    path = tmp_path / "ring.csv"
    path.write_text(HEADER + "\n".join(row.replace(",5.5,", ",0,") for row in circle()) + "\n")
    with pytest.raises(TrackError, match="a width to one side of the centre line is 0 m"):
        read_track(path)
