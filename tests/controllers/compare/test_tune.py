"""The search for parameters of controllers."""

import math
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from controllers.compare.config import TuneConfig
from controllers.compare.tune import evaluate, propose, tune
from controllers.drive.config import DriveConfig
from controllers.drive.disturbance import DISTURBANCES
from controllers.drive.run import drive, read_parameters
from simulator.track.catalogue import OWN_TRACKS, find_track
from trackfeatures import UserError


def test_the_search_finds_better_parameters_and_is_continued(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A reward that falls with the distance from 1 in log space replaces the drives."""
    counted = []

    def evaluate(config: TuneConfig, controller: str, parameters: dict[str, float]) -> float:
        counted.append(parameters)
        if not parameters:
            return -10.0
        return -sum(abs(math.log(value)) for value in parameters.values())

    monkeypatch.setattr("controllers.compare.tune.evaluate", evaluate)
    config = TuneConfig(
        out=tmp_path / "tuned.json", controllers="lqr,mpc", tracks="oval", budget=60
    )
    content = tune(config)
    assert len(counted) == 120
    assert tune(config) == content
    assert len(counted) == 120
    for name in ("lqr", "mpc"):
        found = content["controllers"][name]
        assert found["untuned"] == -10.0
        explored = max(one["reward"] for one in found["tried"][:21])
        assert found["reward"] > max(explored, -5.0)
        assert read_parameters(config.out, name) == found["parameters"]
    with pytest.raises(UserError, match="other settings"):
        tune(replace(config, seed=1))


def test_a_track_file_that_was_edited_needs_another_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("controllers.compare.tune.evaluate", lambda *_: 1.0)
    track = tmp_path / "mine.toml"
    config = TuneConfig(
        out=tmp_path / "t.json", controllers="lqr", tracks="mine", budget=1, tracks_dir=tmp_path
    )
    shutil.copy(OWN_TRACKS / "oval.toml", track)
    tune(config)
    shutil.copy(OWN_TRACKS / "town.toml", track)
    with pytest.raises(UserError, match="other settings"):
        tune(config)


def test_two_searches_do_not_write_the_same_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = TuneConfig(out=tmp_path / "t.json", controllers="lqr", tracks="oval", budget=1)

    def evaluate(*_: object) -> float:
        with pytest.raises(UserError, match="another process is writing to"):
            tune(replace(config, controllers="mpc"))
        return 1.0

    monkeypatch.setattr("controllers.compare.tune.evaluate", evaluate)
    tune(config)
    assert [path.name for path in tmp_path.iterdir()] == ["t.json"]


def test_the_reward_of_a_candidate_is_the_mean_of_single_drives() -> None:
    config = TuneConfig(tracks="oval,town", steps=60, seed=2, disturbance="noise")
    alone = [
        drive(
            DriveConfig("lqr", name, steps=60, seed=2, start_d=-find_track(name).width / 6),
            disturbance=DISTURBANCES["noise"],
            parameters={"rho": 0.1},
        ).score_per_step
        for name in ("oval", "town")
    ]
    assert evaluate(config, "lqr", {"rho": 0.1}) == np.mean(alone)


def test_candidates_stay_within_their_ranges() -> None:
    ranges = {"a": (0.1, 10.0)}
    rng = np.random.default_rng(0)
    tried: list[dict[str, Any]] = []
    for _ in range(50):
        parameters = propose(ranges, tried, 50, rng)
        tried.append({"parameters": parameters, "reward": sum(parameters.values())})
    assert tried[0]["parameters"] == {}
    assert all(0.1 <= one["parameters"]["a"] <= 10.0 for one in tried[1:])
    assert tried[-1]["parameters"]["a"] > 5.0  # near the best, at the end


def search(budget: int, reward_of_the_defaults: float) -> list[dict[str, Any]]:
    """Return the sets that are tried for a parameter whose best value is 1, with the reward -1."""
    tried: list[dict[str, Any]] = []
    for number in range(budget):
        rng = np.random.default_rng([0, number])
        parameters = propose({"a": (1e-3, 1e3)}, tried, budget, rng)
        reward = -1.0 - abs(math.log(parameters["a"])) if parameters else reward_of_the_defaults
        tried.append({"parameters": parameters, "reward": reward})
    return tried


def test_the_search_narrows_while_the_default_parameters_are_the_best() -> None:
    tried = search(60, reward_of_the_defaults=0.0)
    assert all(abs(math.log(one["parameters"]["a"])) < 1.5 for one in tried[-5:])
    others = search(60, reward_of_the_defaults=-50.0)
    assert [one["parameters"] for one in tried] == [one["parameters"] for one in others]


@pytest.mark.parametrize("budget", [1, 2, 3])
def test_a_small_budget_begins_with_the_default_parameters(budget: int) -> None:
    first, *others = search(budget, reward_of_the_defaults=0.0)
    assert first["parameters"] == {}
    assert all(1e-3 <= one["parameters"]["a"] <= 1e3 for one in others)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"controllers": "torcs"}, "'torcs' cannot be tuned; use some of: lqr"),
        ({"reward": "speed"}, "no reward 'speed'"),
        ({"budget": 0}, "budget of 0"),
        ({"disturbance": "storm"}, "no disturbance 'storm'; use one of: none, noise"),
        ({"tracks": "oval,nowhere", "budget": 1, "steps": 20, "controllers": "lqr"}, "nowhere"),
    ],
)
def test_a_wrong_search_is_refused_before_its_first_drive(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, changes: dict[str, Any], message: str
) -> None:
    monkeypatch.setattr("controllers.compare.tune.drive_many", lambda *_: pytest.fail("driven"))
    with pytest.raises(UserError, match=message):
        tune(TuneConfig(out=tmp_path / "tuned.json", **changes))
    assert not (tmp_path / "tuned.json").exists()
