"""Options, actions and resets that a vector environment refuses, with the number of the car."""

import re
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

from simulator.env.vector import PER_CAR
from tests.simulator.env.test_vector import ID, assert_equal, make_vector
from trackfeatures.errors import UserError


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"track": ["oval", "no-such-track", "town"]}, r"^car 1: there is no track"),
        ({"lanes": [1, 2]}, "^lanes is a list of 2 for 3 cars; give one entry for each car"),
        ({"lanes": [1, 2, 4]}, "^car 2: a road of 4 lanes"),
        ({"lanes": 2.0, "roads": "varied"}, "^a road of 2.0 lanes"),
        ({"lanes": [1, True, 2]}, "^car 1: a road of True lanes"),
        ({"start": {"s": [1.0, 2.0]}}, "^s is a list of 2 for 3 cars"),
        ({"start": [{}, {"where": 1.0}, {}]}, "^car 1: start has 'where'"),
        ({"friction": [1.0, -0.5, 1.0]}, "^car 1: friction is -0.5; give a factor above 0"),
        ({"mass": (1.2, 0.8)}, r"^mass is \(1.2, 0.8\); give a finite number, or a range"),
        ({"mass": float("nan")}, "^mass is nan"),
        ({"lane_width": (2.0, 4.0)}, "^lane width 2.0 m is out of range"),
        ({"traffic": [0, 0, 50]}, "^car 2: 50 traffic cars"),
        ({"threads": 0}, "^threads is 0"),
        ({"threads": True}, "^threads is True"),
        ({"autoreset_mode": "Never"}, "^autoreset_mode is 'Never'; choose NextStep, SameStep or"),
        ({"max_episode_steps": 0}, "^max_episode_steps is 0; give a whole number of 1 or more"),
        ({"max_episode_steps": 2.5}, "^max_episode_steps is 2.5"),
        ({"track": ["oval", None, "town"]}, "^car 1: track is None"),
        ({"start": [{}, {}, None]}, "^car 2: start is None; give a dict"),
        ({"copy": "no"}, "^copy is 'no'; give True or False"),
        ({"trafic": 3}, "did you mean 'traffic'"),
        ({"frequency_hz": 30}, "30 Hz"),
    ],
)
def test_bad_options_name_the_car(options: dict[str, Any], message: str) -> None:
    with pytest.raises(UserError, match=message):
        make_vector(3, **options)


def test_the_page_names_the_options_that_take_ranges() -> None:
    """`start` takes ranges as its entries, so it is no range itself."""
    root = Path(__file__).parents[3]
    page = (root / "docs" / "how-to" / "vector-environments.md").read_text(encoding="utf-8")
    (line,) = (row for row in page.splitlines() if "a tuple `(least, greatest)`" in row)
    named = set(re.findall("`([a-z_]+)`", line.split("a tuple")[0]))
    taken = {"start"}
    for name in PER_CAR:
        try:
            make_vector(1, **({"track": "oval"} | {name: (3, 3)})).close()
        except UserError:
            continue
        taken.add(name)
    assert named == taken


@pytest.mark.parametrize("count", [0, -1, 2.0, True, "3", None])
def test_bad_numbers_of_cars_are_refused(count: Any) -> None:
    with pytest.raises(UserError, match=r"^num_envs is .*; give a whole number of 1 or more"):
        make_vector(count)


@pytest.mark.parametrize(
    ("actions", "message"),
    [
        ([[0.0], [np.nan], [0.0]], "^car 1: the action has steer = nan; give a finite number"),
        ([[0.0], [0.0], [1.5]], "^car 2: the action has steer = 1.5"),
        ([[0.0], [0.0]], r"^the actions have shape \(2, 1\); give one row a car, shape \(3, 1\)"),
        ([0.0, 0.0, 0.0], r"shape \(3,\)"),
        ("left", "no array of numbers"),
    ],
)
def test_a_bad_action_moves_no_car(actions: Any, message: str) -> None:
    vector = make_vector(3)
    vector.reset(seed=0)
    good = np.full((3, 1), 0.1, np.float32)
    expected = [vector.step(good) for _ in range(3)]
    vector.reset(seed=0)
    for step in range(3):
        with pytest.raises(UserError, match=message):
            vector.step(actions)
        assert_equal(vector.step(good), expected[step])
    clipped = np.array([[1.0000001], [-1.0000001], [0.0]])
    vector.step(clipped)
    vector.close()


def test_bad_resets_name_the_car_and_reset_none() -> None:
    vector = make_vector(3)
    with pytest.raises(gym.error.ResetNeeded, match="call reset"):
        vector.step(np.zeros((3, 1)))
    with pytest.raises(gym.error.ResetNeeded, match="first reset must reset all"):
        vector.reset(options={"reset_mask": np.array([True, False, True])})
    vector.reset(seed=1)
    *_, before = vector.step(np.zeros((3, 1)))
    refused: list[tuple[dict[str, Any], str]] = [
        ({"options": {"speed": [0.0, "fast", 0.0]}}, "^car 1: reset got speed = 'fast'"),
        ({"options": {"velocity": 3.0}}, "unknown options"),
        ({"options": {"s": [1.0, 2.0]}}, "^s is a list of 2 for 3 cars"),
        ({"options": {"reset_mask": np.zeros(3, bool)}}, "at least one of them True"),
        ({"options": {"reset_mask": np.ones(2, bool)}}, "array of 3 truth values"),
        ({"seed": [1, 2]}, "^seed is a list of 2 for 3 cars"),
        ({"seed": [1, 2, -3]}, "^car 2: seed is -3; give a whole number of 0 or more"),
        ({"seed": -1}, "^seed is -1"),
        ({"seed": 1.5}, "^seed is 1.5"),
        ({"seed": "abc"}, "^seed is 'abc'"),
        ({"options": [1]}, r"^options is \[1\]; give a dict"),
        ({"options": {"to_middle": [0.0, 0.0, 50.0]}}, "^car 2: reset got to_middle = 50.0 m"),
        ({"options": {"to_middle": [0.0, (0.0, 50.0), 0.0]}}, "^car 1: reset got to_middle = 50"),
        ({"options": {"speed": [0.0, (5.0, 1.0), 0.0]}}, r"^car 1: speed is \(5.0, 1.0\); give"),
        ({"options": {"angle": [0.0, 0.0, np.nan]}}, "^car 2: reset got angle = nan"),
    ]
    for arguments, message in refused:
        with pytest.raises(UserError, match=message):
            vector.reset(**arguments)
    *_, after = vector.step(np.zeros((3, 1)))
    np.testing.assert_array_equal(after["steps"], before["steps"] + 1)
    counted, listed = (vector.reset(seed=each)[1]["score"] for each in (np.arange(3), [0, 1, 2]))
    np.testing.assert_array_equal(counted, listed)
    vector.close()
    with pytest.raises(UserError, match=r"^this environment is closed; make a new one"):
        vector.reset(seed=0)
    with pytest.raises(gym.error.ResetNeeded):
        vector.step(np.zeros((3, 1)))


@pytest.mark.parametrize("roads", ["paper", "varied"])
def test_a_start_that_does_not_fit_on_all_random_lanes_is_refused_at_the_first_reset(
    roads: str,
) -> None:
    options: dict[str, Any] = {
        "lanes": (1, 3),
        "track": "town",
        "roads": roads,
        "start": {"to_middle": 4.9},
    }
    vector = make_vector(8, **options)
    with pytest.raises(UserError, match=r"^car 0: reset got to_middle = 4.9 m; the road ends 4.50"):
        vector.reset(seed=0)
    env = gym.make(ID, **options)
    for seed in range(4):
        with pytest.raises(UserError, match=r"to_middle = 4.9 m; the road ends 4.50 m"):
            env.reset(seed=seed)
    vector.close()
    env.close()


@pytest.mark.parametrize(
    ("start", "message"),
    [
        ({"to_middle": (-4.0, 4.0)}, "reset got to_middle = -4.0 m; the road ends 3.50 m"),
        ({"speed": (100.0, 200.0)}, "reset got speed = 200.0; give m/s between"),
    ],
)
def test_a_start_that_does_not_fit_on_all_random_roads_is_refused_at_the_first_reset(
    start: dict[str, Any], message: str
) -> None:
    vector = make_vector(2, track="random", start=start)
    with pytest.raises(UserError, match=f"^car 0: {message}"):
        vector.reset(seed=0)
    env = gym.make(ID, track="random", start=start)
    for seed in range(4):
        with pytest.raises(UserError, match=message):
            env.reset(seed=seed)
    vector.close()
    env.close()


def test_a_start_on_the_edge_of_the_narrowest_random_road_fits_on_all_random_roads() -> None:
    env = gym.make(ID, track="random", start={"to_middle": 3.5})
    for seed in range(8):
        assert env.reset(seed=seed)[1]["to_middle"] == pytest.approx(3.5)
    env.close()
