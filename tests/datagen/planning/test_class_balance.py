"""Class balance of the road ahead: forecast over many seeds, and compared with simulation."""

from collections import Counter
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray

import trackfeatures as tf
from datagen.driving.scripted_driver import ScriptedDriver
from datagen.driving.trajectory import make_course
from datagen.planning.class_balance import (
    MIN_SHARE,
    TARGET_SHARE,
    TrackForecast,
    balance_starts,
    expected_shares,
    expected_speed,
)
from datagen.planning.config import CollectConfig, TrackChoice
from datagen.planning.plan import RoundPlan
from datagen.planning.planner import make_plan
from datagen.planning.tracks import choose_tracks
from simulator.driving.speed import LATERAL_ACCELERATION, bend_profile, speed_profile
from simulator.track.catalogue import find_track, track_files
from simulator.track.road import Road
from simulator.world.world import World

OWN = ("circuit", "countryside", "forest", "gravel-valley", "highway", "mountain-pass", "town")


TORCS = (
    "forza", "alpine-1", "alpine-2", "eroad", "g-track-1", "g-track-2", "g-track-3", "e-track-2",
    "e-track-3",
)  # fmt: skip


def tracks_of(source: str) -> tuple[TrackChoice, ...]:
    if source == "own":
        return choose_tracks(OWN, None)
    if not set(TORCS) <= set(track_files()):
        pytest.skip("no TORCS tracks found; set TORCS_TRACKS")
    return choose_tracks(TORCS if source == "torcs" else (), None)


@cache
def forecast_of(source: str) -> TrackForecast:
    return TrackForecast.of(tracks_of(source), None)


@pytest.mark.parametrize("source", ["own", "torcs", "default"])
@pytest.mark.parametrize(("rounds", "frames"), [(60, 2000), (60, 300), (16, 500)])
@pytest.mark.parametrize("seeds", [2, pytest.param(10, marks=pytest.mark.extended)])
def test_no_class_is_rare_on_either_side_whatever_the_seed(
    source: str, rounds: int, frames: int, seeds: int
) -> None:
    tracks, forecast = tracks_of(source), forecast_of(source)
    moved, before = [], []
    for seed in range(seeds):
        wanted = CollectConfig(rounds, frames, seed=seed, tracks=tracks)
        plan, plain = make_plan(wanted, forecast), make_plan(wanted)
        if seed == 0:
            assert plan == make_plan(wanted, forecast)
        for side in ("train", "test"):
            mine = [entry for entry in plan.rounds if entry.split == side]
            assert expected_shares(mine, forecast).min() >= TARGET_SHARE > MIN_SHARE
            mine = [entry for entry in plain.rounds if entry.split == side]
            before.append(expected_shares(mine, forecast).min())
        others = [replace(e, start=0.0) for e in plan.rounds]
        assert others == [replace(e, start=0.0) for e in plain.rounds]
        pairs = zip(plan.rounds, plain.rounds, strict=True)
        moved.append(sum(new != old for new, old in pairs))
    assert np.mean(moved) < 0.25 * rounds
    if rounds < 60:
        assert min(before) < MIN_SHARE  # so balancing had to change something


def test_balancing_accepts_a_class_that_the_tracks_do_not_have() -> None:
    tracks = choose_tracks(("oval",), None)
    forecast = TrackForecast.of(tracks, None)
    plan = make_plan(CollectConfig(6, 1000, seed=1, tracks=tracks), forecast)
    assert expected_shares(plan.rounds, forecast)[tf.RoadClass.RIGHT] == 0.0


def test_balancing_moves_only_the_starts_that_help_most() -> None:
    """Two rounds on a road that is straight from 0 to 0.5 and bends left, then right, after it."""

    def forecast(entry: RoundPlan, starts: NDArray[np.float64]) -> NDArray[np.float64]:
        left = (starts >= 0.5) & (starts < 0.75)
        right = starts >= 0.75
        return np.stack([left, ~(left | right), right], axis=1).astype(float)

    plan = make_plan(
        CollectConfig(6, 10, seed=1, tracks=(TrackChoice("t", "0" * 64),), test_share=0.0)
    )
    starts = (0.0, 0.1, 0.2, 0.3, 0.6, 0.4)
    rounds = [replace(e, start=s) for e, s in zip(plan.rounds, starts, strict=True)]
    made = balance_starts(rounds, forecast)
    assert expected_shares(rounds, forecast).tolist() == pytest.approx([1 / 6, 5 / 6, 0.0])
    assert expected_shares(made, forecast).tolist() == pytest.approx([1 / 3, 1 / 3, 1 / 3])
    assert made[4] == rounds[4]
    assert sum(a != b for a, b in zip(made, rounds, strict=True)) == 3


def test_the_forecast_over_a_lap_is_the_share_of_lap_time_in_each_class() -> None:
    """Over a whole lap the shares do not depend on the start."""
    track = find_track("oval")
    forecast = TrackForecast({"oval": track})
    plan = make_plan(
        CollectConfig(1, 100, seed=1, tracks=choose_tracks(("oval",), None), lanes=(2,))
    )
    profile = speed_profile(track, expected_speed(plan.rounds[0]), 5.0)
    lap_s = (profile.cell_m / profile.limit).sum()
    entry = replace(plan.rounds[0], frames=round(20 * lap_s))
    shares = forecast(entry, np.array([0.0, 0.3, 0.9]))
    assert np.allclose(shares, shares[0], atol=0.01)
    assert shares.sum(axis=1) == pytest.approx([1.0, 1.0, 1.0])
    # In closed form: the oval's two bends, extended by 20 m ahead, at constant speed.
    s = np.arange(0.0, track.length_m, 0.1)
    bends = np.abs(track.at(s).curvature) >= 1 / 170
    soon = np.abs(track.at(s + tf.LOOK_AHEAD_M).curvature) >= 1 / 170
    if profile.limit.min() == profile.limit.max():
        assert shares[0, tf.RoadClass.LEFT] == pytest.approx((bends | soon).mean(), abs=0.01)


def test_the_expected_speed_on_one_lane_is_limited_by_traffic() -> None:
    plan = make_plan(CollectConfig(1, 100, seed=1, tracks=choose_tracks(("oval",), None)))
    entry = replace(plan.rounds[0], speed_kmh=72.0, lanes=1, traffic=0)
    assert expected_speed(entry) == pytest.approx(20.0)
    assert expected_speed(replace(entry, traffic=1)) == pytest.approx(51.0 / 3.6)
    assert expected_speed(replace(entry, traffic=1, lanes=2)) == pytest.approx(20.0)
    assert expected_speed(replace(entry, traffic=1, speed_kmh=45.0)) == pytest.approx(12.5)


def test_the_bend_profile_equals_a_backward_braking_pass() -> None:
    track = find_track("mountain-pass")
    profile = bend_profile(track, 2.0)
    cells = len(profile.limit)
    bend = np.abs(track.at((np.arange(cells) + 0.5) * profile.cell_m).curvature)
    squared = LATERAL_ACCELERATION / np.maximum(bend / np.maximum(1.0 - 2.0 * bend, 0.3), 1e-6)
    for at in range(2 * cells - 1, -1, -1):
        ahead = squared[(at + 1) % cells] + 2.0 * 2.5 * profile.cell_m
        squared[at % cells] = min(squared[at % cells], ahead)
    assert np.allclose(profile.limit, np.sqrt(squared), rtol=1e-9)


@pytest.mark.parametrize(("traffic", "error"), [(False, 0.03), (True, 0.12)])
def test_driven_class_shares_are_near_the_forecast(traffic: bool, error: float) -> None:
    """Rounds simulated without rendering; in short rounds, traffic causes most of the error."""
    tracks = choose_tracks(("circuit", "forest", "town"), None)
    forecast = TrackForecast.of(tracks, None)
    plan = make_plan(CollectConfig(8, 300, seed=3, tracks=tracks), forecast)
    rounds = [entry if traffic else replace(entry, traffic=0) for entry in plan.rounds]
    counts: Counter[tf.RoadClass] = Counter()
    for entry in rounds:
        counts += _driven(entry)
    found = np.array([counts[kind] for kind in tf.RoadClass]) / counts.total()
    assert counts.total() == 8 * 300
    assert found.min() > MIN_SHARE
    assert np.abs(found - expected_shares(rounds, forecast)).max() < error


def _driven(entry: RoundPlan) -> Counter[tf.RoadClass]:
    road = Road(find_track(entry.track), entry.lanes)
    course = make_course(entry.trajectory, road, 900.0, np.random.default_rng(entry.seed))
    driver = ScriptedDriver(road, course, entry.speed_kmh / 3.6)
    seen: Counter[tf.RoadClass] = Counter()
    driven, start = 0.0, entry.start * road.track.length_m
    with World(road, traffic=entry.traffic) as world:
        state = world.reset(
            seed=entry.seed,
            s=start,
            to_middle=driver.offset_at(0.0),
            speed=driver.speed_at(start),
        )
        for _ in range(entry.frames):
            seen[world.features().heading] += 1
            state = world.step(driver.command(state, world.traffic, driven))
            driven += state.speed / 20.0
    return seen
