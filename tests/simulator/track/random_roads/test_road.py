"""Random roads: closed, clear of themselves, within their ranges, the same on every machine."""

import math
import time
from collections import Counter
from collections.abc import Callable
from contextlib import closing
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from numpy.typing import NDArray

import trackfeatures as tf
from simulator.driving.speed import bend_profile
from simulator.track.catalogue import find_track
from simulator.track.errors import UnknownTrack
from simulator.track.geometry import Track
from simulator.track.random_roads.kinds import BLOCK, kind_of, kinds
from simulator.track.random_roads.road import random_track, road_file
from simulator.track.road import Road
from simulator.track.toml_track import Table, build_track

SEEDS = range(100)
FloatArray = NDArray[np.float64]


@pytest.fixture(scope="module")
def contents() -> dict[int, dict[str, Any]]:
    """The TOML content of each road."""
    return {seed: road_file(seed) for seed in SEEDS}


@pytest.fixture(scope="module")
def roads(contents: dict[int, dict[str, Any]]) -> dict[int, Track]:
    return {
        seed: build_track(Table(content, "test"), f"random:{seed}")
        for seed, content in contents.items()
    }


def test_every_road_closes_within_a_micrometre(roads: dict[int, Track]) -> None:
    for track in roads.values():
        last, turn = len(track.s0) - 1, track.curvature0[-1] * track.length[-1]
        end = track.at(track.length_m * (1.0 - 1e-15), [4.0, 0.0, -4.0])
        start = track.at(0.0, [4.0, 0.0, -4.0])
        for axis in ("x", "y", "z"):
            assert np.abs(getattr(end, axis) - getattr(start, axis)).max() < 1e-6
        gap = math.remainder(track.heading0[last] + turn - track.heading0[0], 2.0 * math.pi)
        assert abs(gap) < 1e-9


def test_rows_are_within_the_ranges_of_their_kind(contents: dict[int, dict[str, Any]]) -> None:
    for seed, content in contents.items():
        kind = kind_of(seed)
        assert kind.width_m[0] <= content["width"] <= kind.width_m[1]
        assert content["look"] in (*kind.looks, "gravel")
        for row in content["segment"]:
            assert abs(row["grade"]) <= kind.grade_percent[1]
            if row["type"] == "bend":
                assert kind.radius_m[0] <= row["radius"] <= kind.radius_m[1]
                assert 0.0 <= row["banking"] <= kind.banking_deg[1]
            else:
                assert row["length"] > 0.3


def test_roads_reach_from_12_m_to_5_km_and_stay_drivable(
    contents: dict[int, dict[str, Any]], roads: dict[int, Track]
) -> None:
    rows = [row for content in contents.values() for row in content["segment"]]
    bends = [row for row in rows if row["type"] == "bend"]
    radii = np.array([row["radius"] for row in bends])
    assert radii.min() >= 12.0
    assert radii.max() <= 5000.0
    assert radii.min() < 12.5
    assert radii.max() > 4000.0
    assert 7.0 < max(row["banking"] for row in bends) <= 8.0
    grades = np.array([max(map(abs, track.grade_range)) for track in roads.values()])
    assert 0.1 < grades.max() <= 0.12
    # Some bends begin abruptly, others with a spiral.
    assert 0.3 < np.mean([row["spiral"] == 0.0 for row in bends]) < 0.8
    for track in roads.values():
        # No kinks: the grade changes by at most 6 % over 10 m.
        slopes = np.diff(track.at(np.arange(0.0, track.length_m, 2.0)).z) / 2.0
        assert np.abs(slopes[5:] - slopes[:-5]).max() < 0.06


def crossings(x: FloatArray, y: FloatArray, lap: int) -> int:
    """Number of pairs of segments that cross, of closed lines of `lap` points each, end to end."""
    nxt = np.roll(np.arange(len(x)).reshape(-1, lap), -1, axis=1).ravel()
    dx, dy = (x[nxt] - x)[:, None], (y[nxt] - y)[:, None]
    side = dx * (y - y[:, None]) - dy * (x - x[:, None])  # of segment (row): of each point (column)
    apart = side * side[:, nxt] < 0.0
    return int((apart & apart.T).sum() // 2)


def walls(track: Track, offset: float, count: int) -> tuple[FloatArray, FloatArray]:
    s = np.linspace(0.0, track.length_m, count, endpoint=False)
    left, right = track.at(s, offset), track.at(s, -offset)
    return np.concatenate((left.x, right.x)), np.concatenate((left.y, right.y))


def test_the_oracle_of_crossings_counts_them() -> None:
    t = np.linspace(0.0, 2.0 * np.pi, 40, endpoint=False) + 0.05
    assert crossings(np.sin(t), np.sin(2.0 * t), 40) == 1
    assert crossings(np.sin(t), np.cos(t), 40) == 0
    both = np.concatenate((np.sin(t), np.sin(t) + 0.5)), np.concatenate((np.cos(t), np.cos(t)))
    assert crossings(*both, 40) == 2


def test_walls_up_to_12_m_from_the_middle_never_cross(roads: dict[int, Track]) -> None:
    widest = 3 * 4.3 / 2 + 3.0 + 2.5  # three lanes, shoulders of 3 m, and as far to the wall
    assert widest < 12.0
    assert max(Road(track, 3).wall_offset for track in roads.values()) < 12.0
    for seed, track in roads.items():
        count = min(int(track.length_m / 5.0), 250)
        assert crossings(*walls(track, widest, count), count) == 0, f"random:{seed}"


def interest(track: Track, lanes: int, speed_kmh: float) -> tuple[FloatArray, FloatArray]:
    """Shares of the time of a lap: in bends under 100 m or within 8 m of a change of curvature; and
    in bends of 12 to 25, 25 to 50 and 50 to 100 m (3,)."""
    profile = bend_profile(track, lanes * tf.LANE_WIDTH_M / 2 + 1.0)
    s = (np.arange(len(profile.limit)) + 0.5) * profile.cell_m
    seconds = 1.0 / np.minimum(profile.limit, speed_kmh / 3.6)
    seconds /= seconds.sum()
    bend = np.abs(track.at(s).curvature)
    ahead = np.stack([track.at(s + metres).curvature for metres in range(9)])
    tight = (bend > 0.01) | (np.abs(ahead - ahead[0]) > 1e-9).any(axis=0)
    radius = 1.0 / np.maximum(bend, 1e-9)
    return seconds[tight].sum(), np.histogram(radius, (12, 25, 50, 100), weights=seconds)[0]


def test_half_of_the_time_is_in_tight_bends_or_near_changes_log_evenly(
    roads: dict[int, Track],
) -> None:
    rng = np.random.default_rng(5)
    found = [
        interest(track, seed % 3 + 1, rng.uniform(40.0, 75.0)) for seed, track in roads.items()
    ]
    assert 0.5 < np.mean([share for share, _ in found]) < 0.62
    octaves = np.mean([bins for _, bins in found], axis=0)
    assert octaves.min() > 0.09
    assert octaves.max() < 1.4 * octaves.min()


def test_a_block_of_seeds_has_each_kind_in_its_share() -> None:
    shares = {kind.name: kind.share for kind in kinds()}
    assert sum(shares.values()) == BLOCK
    assert set(shares) == {"motorway", "country", "town", "pass"}
    for block in range(5):
        found = Counter(kind_of(block * BLOCK + i).name for i in range(BLOCK))
        assert found == shares


GOLDEN = {
    0: ("town", "a29664acc5fe49bd"),
    1: ("motorway", "b203541e45fbcbae"),
    5: ("country", "5b4c996239c2b940"),
    7: ("pass", "eaa4a9d1f04e7bac"),
}


@pytest.mark.parametrize("seed", GOLDEN)
def test_golden_roads(seed: int) -> None:
    """These change with the ranges, the drawing or numpy's generator: note it in CHANGELOG.md."""
    assert (kind_of(seed).name, find_track(f"random:{seed}").content_hash[:16]) == GOLDEN[seed]


def test_the_hash_survives_other_roundings_of_sines(
    monkeypatch: pytest.MonkeyPatch, roads: dict[int, Track]
) -> None:
    """Other processors and libraries round the last bits of sines and logarithms differently."""
    noise = np.random.default_rng(0)

    def rounded(function: Callable[..., Any]) -> Callable[..., Any]:
        def other(*values: Any) -> Any:
            exact = np.asarray(function(*values))
            return exact * (1.0 + noise.uniform(-4e-16, 4e-16, exact.shape))

        return other

    for name in ("sin", "cos", "tan", "exp", "log", "arctan2", "sinc", "hypot", "degrees"):
        monkeypatch.setattr(np, name, rounded(getattr(np, name)))
    for seed in range(12):
        track = random_track.__wrapped__(f"random:{seed}")
        assert track.content_hash == roads[seed].content_hash
        assert 0.0 < np.abs(track.x0 - roads[seed].x0).max() < 1e-9
        assert np.abs(track.y0 - roads[seed].y0).max() < 1e-9


def test_roads_of_other_seeds_differ(roads: dict[int, Track]) -> None:
    assert len({track.content_hash for track in roads.values()}) == len(roads)
    assert len({(track.look, track.markings) for track in roads.values()}) > 0.9 * len(roads)
    assert {track.surface for track in roads.values()} == {"asphalt", "gravel", "concrete"}
    assert find_track("random:007").name == "random:7"
    assert find_track(f"random:{2**63 - 1}").length_m > 500.0


@pytest.mark.parametrize(
    "name", ["random", "random:", "random:-1", "random:x", "random:1.5", "random:" + "9" * 19]
)
def test_a_bad_name_is_one_clear_line(name: str) -> None:
    with pytest.raises(UnknownTrack) as raised:
        find_track(name)
    said = str(raised.value)
    assert repr(name) in said
    assert "random:SEED with a whole number from 0 to" in said
    assert "\n" not in said


def test_an_environment_drives_on_a_random_road() -> None:
    with closing(gym.make("simulator.env:driverview/LateralControl-v0", track="random:7")) as env:
        env.reset(seed=1)
        rewards = [float(env.step(np.zeros(1, np.float32))[1]) for _ in range(20)]
    assert min(rewards) > 0.8


@pytest.mark.alone
def test_a_road_is_drawn_in_less_than_50_ms_of_processor_time() -> None:
    random_track.__wrapped__("random:1000")
    before = time.process_time()
    for seed in range(1001, 1041):
        random_track.__wrapped__(f"random:{seed}")
    assert (time.process_time() - before) / 40 < 0.05
