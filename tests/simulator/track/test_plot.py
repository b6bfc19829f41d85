"""The command `simulator tracks plot`: contents of the figure, and one-line errors."""

import os
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

import trackfeatures as tf
from simulator.track.catalogue import OWN_TRACKS, find_track
from simulator.track.plot import COLOURS, MOST_TICKS, draw, runs, sample, tick_step, write_plot
from simulator.track.road import Road
from tests.typed import typed
from trackfeatures.errors import UserError

COAST = Road(find_track("coast"), 2)


def simulator(folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    return typed("simulator", "tracks", *arguments, folder=folder)


def test_heading_classes_follow_the_shared_definition() -> None:
    lap = sample(COAST)
    track = COAST.track
    for k in range(0, len(lap.s), 97):
        s = float(lap.s[k])
        here, ahead = track.curvature(s), track.curvature(s + 20.0)
        assert lap.classes[k] == tf.classify_heading(here, ahead)
    assert lap.s[-1] == track.length_m
    assert sum(lap.shares.values()) == pytest.approx(1.0)
    assert {kind for *_, kind in runs(lap.classes)} == set(tf.RoadClass)


def test_runs_are_contiguous() -> None:
    left, straight = tf.RoadClass.LEFT, tf.RoadClass.STRAIGHT
    found = runs(np.array([1, 1, 0, 0, 0, 1]))
    assert found == [(0, 2, straight), (2, 5, left), (5, 6, straight)]


@pytest.mark.parametrize("length", [120.0, 1376.0, 2770.0, 5784.0, 22_130.0, 90_000.0])
def test_ticks_are_round_and_few(length: float) -> None:
    step = tick_step(length)
    assert length / step <= MOST_TICKS
    assert str(step).rstrip("0") in ("1", "2", "25", "5")


def test_axis_limits_and_labels_match_the_lap() -> None:
    figure = draw(sample(COAST))
    plan, height, curvature, *_ = figure.axes
    assert height.get_xlim() == (0.0, COAST.track.length_m)
    low, high = height.get_ylim()
    assert high - low > COAST.track.z_range_m
    assert curvature.get_ylim()[1] > 1000.0 / COAST.track.min_radius_m
    written = {text.get_text() for axes in figure.axes for text in axes.texts}
    assert {"start", "200", "3,000", "2 lanes of 4 m, asphalt 10 m"} <= written
    assert "3,176 m, 10 m wide" in plan.get_title(loc="left")


def test_every_class_is_drawn_in_its_colour(tmp_path: Path) -> None:
    out = tmp_path / "coast.png"
    write_plot(COAST, out)
    picture = cv2.imread(str(out))
    assert picture is not None
    assert picture.shape == (990, 1760, 3)
    for colour in COLOURS.values():
        rgb = [int(colour[k : k + 2], 16) for k in (1, 3, 5)]
        assert (picture[..., ::-1] == rgb).all(axis=-1).sum() > 500
    assert [path.name for path in tmp_path.iterdir()] == ["coast.png"]


def test_a_name_with_dollar_signs_is_not_a_formula(tmp_path: Path) -> None:
    path = tmp_path / "a$b_$c^d.toml"
    path.write_bytes((OWN_TRACKS / "oval.toml").read_bytes())
    write_plot(Road(find_track(str(path))), tmp_path / "odd.png")
    assert (tmp_path / "odd.png").stat().st_size > 10_000


@pytest.mark.parametrize(
    ("file", "name"),
    [
        (b"caf\xe9.xml", "caf\ufffd"),  # Latin-1
        (b"\xff\xfe one.xml", "\ufffd\ufffd one"),
        ("Ångström 日.xml".encode(), "Ångström 日"),
    ],
)
@pytest.mark.filterwarnings("ignore:Glyph")
def test_tracks_in_files_of_any_name_are_found_and_drawn(
    tmp_path: Path, file: bytes, name: str
) -> None:
    folder = Path(os.fsdecode(bytes(tmp_path) + b"/my tr\xe9cks"))
    folder.mkdir()
    path = folder / os.fsdecode(file)
    path.write_text((Path(__file__).parent / "fixtures" / "sticky-grade.xml").read_text())
    for given in (path.stem, name, str(path)):
        track = find_track(given, folder)
        assert track.name == name
    write_plot(Road(track, 1), path.with_suffix(".png"))
    assert path.with_suffix(".png").read_bytes()[1:4] == b"PNG"


def test_the_command_writes_a_png(tmp_path: Path) -> None:
    (tmp_path / "more").mkdir()
    (tmp_path / "more" / "loop.toml").write_bytes((OWN_TRACKS / "town.toml").read_bytes())
    named = simulator(tmp_path, "plot", "loop", "--tracks-dir", "more", "--lanes", "3")
    assert (named.returncode, named.stdout, named.stderr) == (0, "", "loop.png\n")
    before = simulator(tmp_path, "--tracks-dir", "more", "plot", "loop", "--out", "x.png")
    assert before.returncode == 0, before.stderr
    # One lane and three are different pictures.
    assert (tmp_path / "x.png").read_bytes() != (tmp_path / "loop.png").read_bytes()


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("no-such-track",), "no track 'no-such-track'"),
        (("oval", "--out", "x.jpg"), "ends in .png"),
        (("oval", "--out", "no/x.png"), "there is no folder no"),
        (("oval", "--lanes", "4"), "a road of 4 lanes"),
    ],
)
def test_errors_are_one_line(tmp_path: Path, arguments: tuple[str, ...], said: str) -> None:
    done = simulator(tmp_path, "plot", *arguments)
    assert done.returncode == 1
    assert done.stderr.startswith("error: ")
    assert said in done.stderr
    assert len(done.stderr.splitlines()) == 1
    assert list(tmp_path.iterdir()) == []


def test_error_without_matplotlib_names_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    with pytest.raises(UserError, match="pip install matplotlib"):
        draw(sample(COAST))
