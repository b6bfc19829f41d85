"""Choice of test rounds: equal to stored results of the first version, and fast for large plans."""

import json
import re
import time
from pathlib import Path

import numpy as np
import pytest

from datagen.planning.config import CollectConfig, TrackChoice
from datagen.planning.planner import make_plan
from datagen.planning.split import choose_test_rounds

GOLDEN: dict[str, str] = json.loads(Path(__file__).with_name("test_rounds.json").read_text())
"""Numbers of the test rounds as a bit mask (hex), from the first implementation."""


@pytest.mark.parametrize("case", GOLDEN)
def test_test_rounds_equal_those_of_the_first_implementation(case: str) -> None:
    match = re.fullmatch(
        r"(\d+) rounds, seed (\d+), (\d+) tracks, share ([\d.]+), (\d+) scenes", case
    )
    assert match is not None
    rounds, seed, tracks, scenes = (int(match[i]) for i in (1, 2, 3, 5))
    config = CollectConfig(
        rounds=rounds,
        frames=500,
        seed=seed,
        tracks=tuple(TrackChoice(f"track-{i}", f"{i}" * 64) for i in range(tracks)),
        lanes=(1, 2, 3) if scenes == 1 else (1, 2),
        test_share=float(match[4]),
        stretch=0 if scenes == 1 else 1,
        scenes=scenes,
    )
    plan = make_plan(config)
    mask = sum(1 << k for k, entry in enumerate(plan.rounds) if entry.split == "test")
    assert f"{mask:x}" == GOLDEN[case]


@pytest.mark.extended
def test_twenty_thousand_rounds_take_less_than_five_seconds_of_processor_time() -> None:
    count = 20_000
    rng = np.random.default_rng(0)
    tracks = [f"track-{number % 9}" for number in range(count)]
    lanes = [number // 9 % 3 + 1 for number in range(count)]
    trajectories, lights = rng.integers(6, size=count).tolist(), list(range(count))
    started = time.process_time()
    chosen = choose_test_rounds(0.25, tracks, lanes, (trajectories, lights), rng)
    assert time.process_time() - started < 5.0
    assert len(chosen) == 5000


def test_a_road_keeps_its_last_training_round_while_another_has_two() -> None:
    """Four roads of two rounds each: the test half takes one round of each road."""
    tracks, lanes = ["a", "a", "a", "a", "b", "b", "b", "b"], [1, 1, 2, 2, 1, 1, 2, 2]
    chosen = choose_test_rounds(0.5, tracks, lanes, (), np.random.default_rng(3))
    assert sorted(number // 2 for number in chosen) == [0, 1, 2, 3]


def test_a_single_round_or_a_test_share_of_zero_gives_no_test_round() -> None:
    rng = np.random.default_rng(0)
    assert choose_test_rounds(0.25, ["a"], [1], (), rng) == set()
    assert choose_test_rounds(0.0, ["a", "a", "b"], [1, 1, 1], (), rng) == set()
