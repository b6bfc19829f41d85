"""`--tracks random`: each round has its own road, and most of its frames have difficult labels."""

from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from datagen.driving.trajectory import max_offset
from datagen.planning.class_balance import TrackForecast
from datagen.planning.config import CollectConfig, TrackChoice
from datagen.planning.plan import Plan, RoundPlan
from datagen.planning.planner import make_plan
from datagen.planning.summary import expected_classes
from datagen.planning.tracks import choose_tracks
from simulator.driving.speed import speed_profile
from simulator.track.catalogue import find_track
from simulator.track.random_roads.road import random_track
from simulator.track.road import Road
from tests.datagen.commands import datagen_here

RANDOM = choose_tracks(("random",), None)
OVAL = choose_tracks(("oval",), None)


def planned(**options: Any) -> Plan:
    return make_plan(replace(CollectConfig(rounds=6, frames=100, tracks=RANDOM), **options))


def test_each_round_has_the_road_of_its_seed() -> None:
    plan = planned()
    assert (TrackChoice("random", ""),) == RANDOM
    assert [entry.track for entry in plan.rounds] == [f"random:{e.seed}" for e in plan.rounds]
    assert all(e.track_hash == find_track(e.track).content_hash for e in plan.rounds)
    assert Counter(entry.lanes for entry in plan.rounds) == {1: 2, 2: 2, 3: 2}
    assert {entry.split for entry in plan.rounds} == {"train", "test"}
    assert plan == planned()


def test_plans_of_other_seeds_and_splits_share_no_road() -> None:
    plans = planned(), planned(seed=1), planned(split="unseen")
    assert len({plan.hash for plan in plans}) == 3
    assert len({entry.track for plan in plans for entry in plan.rounds}) == 18


def test_random_stands_beside_named_tracks() -> None:
    plan = planned(tracks=(*OVAL, *RANDOM, *choose_tracks(("random:5",), None)))
    tracks = [entry.track for entry in plan.rounds]
    assert tracks.count("oval") == 2
    assert tracks.count("random:5") >= 2
    assert sum(f"random:{entry.seed}" == entry.track for entry in plan.rounds) >= 2


def test_no_heading_class_is_rare() -> None:
    forecast = TrackForecast.of(RANDOM, None)
    plan = make_plan(CollectConfig(rounds=20, frames=400, tracks=RANDOM), forecast)
    assert min(expected_classes(plan, forecast)["all"].values()) > 0.15


def driven(entry: RoundPlan) -> tuple[float, np.ndarray]:
    """Shares of a round's frames: in bends under 100 m or within 8 m of a change of curvature; and
    in bends of 12 to 25, 25 to 50, 50 to 100 m (3,)."""
    road = Road(random_track(entry.track), entry.lanes, entry.lane_width_m)
    profile = speed_profile(road.track, entry.speed_kmh / 3.6, max_offset(road))
    s, places = entry.start * road.track.length_m, []
    for _ in range(entry.frames):
        places.append(s)
        s += profile.at(s) / entry.frequency_hz
    curvature = road.track.at(np.array(places)[:, None] + np.arange(9)).curvature
    bend = np.abs(curvature[:, 0])
    hard = (bend > 0.01) | (np.abs(curvature - curvature[:, :1]) > 1e-9).any(axis=1)
    radius = 1.0 / np.maximum(bend, 1e-9)
    return float(hard.mean()), np.histogram(radius, (12, 25, 50, 100))[0] / entry.frames


@pytest.mark.parametrize("rounds", [40, pytest.param(200, marks=pytest.mark.extended)])
def test_half_of_the_frames_are_in_tight_bends_or_near_changes_log_evenly(rounds: int) -> None:
    plan = make_plan(
        CollectConfig(rounds=rounds, frames=400, tracks=RANDOM), TrackForecast.of(RANDOM, None)
    )
    shares, bins = zip(*(driven(entry) for entry in plan.rounds), strict=True)
    assert 0.5 < np.mean(shares) < 0.65
    octaves = np.mean(bins, axis=0)
    assert octaves.min() > 0.09
    assert octaves.max() < 1.5 * octaves.min()


def test_a_dry_run_counts_random_roads_together() -> None:
    options = "--rounds 6 --frames 50 --tracks random,oval --dry-run"
    shown = datagen_here("collect", *options.split())
    assert shown.returncode == 0, shown.stderr
    [counts] = [line for line in shown.stdout.splitlines() if line.startswith(" track")]
    assert "random 3" in counts
    assert "random:" not in counts
    assert shown.stdout.count("random:") == 3


@pytest.mark.extended
def test_a_collection_on_random_roads_resumes_and_counts_them_together(tmp_path: Path) -> None:
    options = "--rounds 2 --frames 2 --tracks random --workers 1 --lights clear --json"
    command = ("collect", *options.split(), "--out", tmp_path / "d")
    first = datagen_here(*command)
    assert first.returncode == 0, first.stderr
    [removed, _] = sorted((tmp_path / "d").glob("**/*.mcap"))
    before = removed.read_bytes()
    removed.unlink()
    again = datagen_here(*command)
    assert again.returncode == 0, again.stderr
    assert removed.read_bytes() == before
    assert '"recorded_frames": 2' in again.stdout
    shown = datagen_here("stats", tmp_path / "d", "--json")
    assert '"random": 4' in shown.stdout
