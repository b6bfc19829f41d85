"""`--tracks random`: each round has its own road, and most of its frames have difficult labels."""

from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from datagen.planning.class_balance import TrackForecast
from datagen.planning.config import CollectConfig, TrackChoice
from datagen.planning.plan import Plan
from datagen.planning.planner import make_plan
from datagen.planning.summary import expected_classes
from datagen.planning.tracks import choose_tracks
from simulator.track.catalogue import find_track
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
