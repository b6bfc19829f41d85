"""Rounds of `datagen collect --poses placed`: in each frame the car stands at a random pose."""

import json
import re
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

import trackfeatures as tf
from datagen.driving.placement import (
    MAX_ANGLE_RAD,
    RADII_M,
    draw_placements,
    placement_share,
)
from datagen.driving.trajectory import max_offset
from datagen.planning.class_balance import TrackForecast
from datagen.planning.config import CollectConfig
from datagen.planning.planner import make_plan
from datagen.planning.tracks import choose_tracks
from datagen.recording import Dataset
from datagen.recording.names import PLACED
from simulator.track.catalogue import find_track
from simulator.track.geometry import Track
from simulator.track.road import Road
from tests.datagen.commands import datagen_here, recording_here

SEED = 5


@pytest.fixture(scope="module")
def placed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("placed") / "data"
    with recording_here():
        done = datagen_here(
            "collect", "--out", folder, "--poses", PLACED, "--rounds", "2", "--frames", "40",
            "--tracks", "mountain-pass,random", "--lanes", "2", "--seed", str(SEED),
        )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return folder


def test_a_placed_car_stands_somewhere_else_in_each_frame(placed: Path) -> None:
    labels = Dataset.open(placed).select("all").labels
    assert len(labels) == 80
    assert np.abs(labels.speed).max() == 0.0
    assert 0.05 < labels.angle.std() < 0.15
    assert np.abs(labels.angle).max() <= MAX_ANGLE_RAD + 1e-3
    for values in (labels.s, labels.to_middle, labels.angle):
        assert len(set(values.tolist())) == len(values)


def test_placed_rounds_are_verified_and_simulated_again(placed: Path) -> None:
    done = datagen_here("verify", placed, "--level", "deep", "--replay", "2", "--pixels", "--json")
    report = json.loads(done.stdout)
    assert (done.returncode, report["problems"], len(report["replayed"])) == (0, [], 2)


def test_a_dataset_of_drives_is_not_continued_with_placed_cars(placed: Path) -> None:
    done = datagen_here(
        "collect", "--out", placed, "--rounds", "2", "--frames", "40",
        "--tracks", "mountain-pass,random", "--lanes", "2", "--seed", str(SEED),
    )  # fmt: skip
    assert done.returncode != 0
    assert "poses" in done.stderr


@pytest.mark.parametrize("name", ["mountain-pass", "oval", "random:3"])
def test_the_angle_does_not_depend_on_the_curvature_and_rare_radii_are_frequent(name: str) -> None:
    track = find_track(name)
    road = Road(track, 2)
    poses = draw_placements(road, 20_000, np.random.default_rng(1))
    s, offset, angle = np.array([(p.s, p.to_middle, p.angle) for p in poses]).T
    assert (s.min() >= 0.0, s.max() < track.length_m) == (True, True)
    assert np.abs(offset).max() <= max_offset(road)
    curvature = np.asarray(track.at(s).curvature)
    slope = np.cov(angle, curvature)[0, 1] / curvature.var()
    assert abs(slope) < 4.0 * angle.std() / curvature.std() / np.sqrt(len(s))
    lap, drawn = (_classes_of_radius(track, where) for where in (np.arange(track.length_m), s))
    for share, found in zip(lap, drawn, strict=True):
        if 0.0 < share < 0.12:
            assert found > 1.1 * share


def _classes_of_radius(track: Track, s: np.ndarray) -> np.ndarray:
    """Return the share of each class of radius (5,), from under 25 m to over 300 m."""
    places = s[:, None] + np.arange(0.0, tf.LOOK_AHEAD_M + 0.1, 0.5)
    sharpest = np.abs(track.at(places.ravel()).curvature).reshape(places.shape).max(axis=1)
    radius = 1.0 / np.maximum(sharpest, 1e-9)
    return np.histogram(radius, bins=[0.0, *sorted(RADII_M), np.inf])[0] / len(s)


def test_the_forecast_of_the_classes_is_that_of_the_places() -> None:
    choices = choose_tracks(("mountain-pass",), None)
    config = CollectConfig(rounds=1, frames=100, tracks=choices, poses=PLACED)
    forecast = TrackForecast.of(choices, None)
    (entry,) = make_plan(config, forecast).rounds
    assert entry.trajectory == PLACED
    track = find_track("mountain-pass")
    poses = draw_placements(Road(track, entry.lanes), 5_000, np.random.default_rng(2))
    here = [track.curvature(p.s) for p in poses]
    ahead = [track.curvature((p.s + tf.LOOK_AHEAD_M) % track.length_m) for p in poses]
    classes = [tf.classify_heading(*pair) for pair in zip(here, ahead, strict=True)]
    found = np.bincount(classes, minlength=3) / len(classes)
    assert forecast(entry, np.array([0.0, 0.5])) == pytest.approx(np.stack([found] * 2), abs=0.03)


def test_a_lap_shorter_than_the_look_ahead_has_places() -> None:
    class Ring:
        length_m = 12.0

        def at(self, s: np.ndarray) -> "Ring":
            self.curvature = np.full(len(s), 2.0 * np.pi / 12.0)
            return self

    share = placement_share(Ring())  # type: ignore[arg-type]
    assert share == pytest.approx(np.full(12, 1.0 / 12.0))


def test_plans_of_drives_do_not_mention_the_option() -> None:
    tracks = choose_tracks(("oval",), None)
    assert "poses" not in CollectConfig(tracks=tracks).as_dict()
    assert CollectConfig(tracks=tracks, poses=PLACED).as_dict()["poses"] == PLACED
    with pytest.raises(tf.UserError, match="unknown poses 'parked'; choose driven, placed"):
        CollectConfig(tracks=tracks, poses="parked")


def test_the_listing_of_the_plan_has_no_speed_and_no_start() -> None:
    args = ["collect", "--rounds", "2", "--frames", "10", "--tracks", "oval", "--dry-run"]
    for poses, ending in ((PLACED, r"- +-$"), ("driven", r"\d\.\d +0\.\d{3}$")):
        text = datagen_here(*args, "--poses", poses).stdout
        rows = [line.rstrip() for line in text.splitlines() if "round-00" in line]
        assert [bool(re.search(ending, row)) for row in rows] == [True, True]


def test_the_export_to_lerobot_says_that_there_is_no_drive(placed: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    done = datagen_here("export", placed, "--format", "lerobot", "--out", out, "--split", "test")
    assert done.returncode == 0, done.stderr
    (task,) = pq.read_table(out / "meta/tasks.parquet").to_pylist()
    assert "no drive" in " ".join(map(str, task.values()))
