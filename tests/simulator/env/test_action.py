"""Actions of the environments: what is clipped to its bound, and what is refused."""

import math
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

import simulator.env  # noqa: F401  (registers the names)
from simulator.env.action import Controls, to_command
from trackfeatures.errors import UserError


@pytest.mark.parametrize(
    ("action", "message"),
    [
        ([math.nan], "steer = nan; give a finite number"),
        ([1.5], "steer = 1.5"),
        ([-math.inf], "steer = -inf"),
        ([-1.01], "steer"),
        ([0.0, 0.0], "shape"),
        ([0.0, 1.1, 0.0, 1.0], "throttle = 1.1"),
        ([0.0, 0.0, -0.5, 1.0], "brake = -0.5"),
        ([0.0, 0.0, 0.0, 7.0], "gear = 7"),
        (np.array([1.00001], np.float32), "steer = 1.00001001; give a finite number from -1 to 1"),
        (np.array([0.0, -0.00001, 0.0, 1.0], np.float32), "throttle = -9.9999997"),
        ([0.0, 0.0, 0.0, 6.0001], "gear = 6.0001"),
        (0.5, r"the action is 0.5; give 1 number\(s\), shape \(1,\): steer"),
        (np.zeros((1, 1), np.float32), "shape"),
        ([], "shape"),
        (None, "shape"),
        ("left", "'left' is no array of numbers"),
        (["left"], "no array of numbers"),
        ([[0.0], [0.0, 1.0]], "no array of numbers"),
        ({"steer": 0.0}, "no array of numbers"),
        ([1.00000212], "steer = 1.00000212"),
    ],
)
def test_bad_actions_are_refused(action: Any, message: str) -> None:
    full = isinstance(action, list | np.ndarray) and len(action) == 4
    with pytest.raises(UserError, match=message):
        to_command(action, "full" if full else "steer")


@pytest.mark.parametrize(
    ("action", "bound"),
    [
        (np.array([1.0000001], np.float32), [1.0]),
        (np.nextafter(np.array([-1.0], np.float32), np.float32(-2.0)), [-1.0]),
        ([-1.0 - 1e-6], [-1.0]),
        (np.array([0.0, -1e-8, 1.0000001, 6.0000005], np.float32), [0.0, 0.0, 1.0, 6.0]),
        (np.array([-1.0000002, 1.0000004, -1e-7, -1.0000001], np.float32), [-1.0, 1.0, 0.0, -1.0]),
        ([1], [1.0]),
        (np.array([True]), [1.0]),
    ],
)
def test_actions_beyond_a_bound_by_rounding_are_clipped(action: Any, bound: list[float]) -> None:
    controls: Controls = "full" if len(bound) == 4 else "steer"
    assert to_command(action, controls) == to_command(np.array(bound), controls)


def test_a_step_clips_or_refuses_its_action() -> None:
    env = gym.make("driverview/LateralControl-v0", track="circuit", disable_env_checker=True)
    env.reset(seed=0)
    observation, *_ = env.step(np.array([1.0000001], np.float32))
    assert env.observation_space.contains(observation)
    assert env.action_space.contains(np.array([1.0], np.float32))
    with pytest.raises(UserError, match=r"steer = 1\.5"):
        env.unwrapped.step(np.array([1.5], np.float32))
    env.close()
