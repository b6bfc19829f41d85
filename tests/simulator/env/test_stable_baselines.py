"""The adapter for Stable-Baselines3, and the example that trains PPO with it."""

import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from simulator.env.vector import LateralControlVector

sb3 = pytest.importorskip("stable_baselines3", reason="Stable-Baselines3 is not installed")
EXAMPLE = Path(__file__).parents[3] / "examples" / "train_ppo.py"


def test_the_adapter_gives_the_numbers_of_the_vector() -> None:
    from simulator.env.stable_baselines import StableBaselinesCars

    options: dict[str, Any] = {"track": ["oval", "town"], "max_episode_steps": 5}
    adapter = StableBaselinesCars(2, **options)
    vector = LateralControlVector(2, autoreset_mode="SameStep", **options)
    adapter.seed(7)
    np.testing.assert_array_equal(adapter.reset(), vector.reset(seed=7)[0])
    actions = np.array([[0.1], [-0.1]], np.float32)
    for step in range(1, 8):
        observations, rewards, dones, infos = adapter.step(actions)
        expected, paid, ended, cut, info = vector.step(actions)
        np.testing.assert_array_equal(observations, expected)
        np.testing.assert_allclose(rewards, paid, rtol=1e-6)
        assert dones.tolist() == [step == 5] * 2 == (ended | cut).tolist()
        assert [one["TimeLimit.truncated"] for one in infos] == [step == 5] * 2
        if step == 5:
            np.testing.assert_array_equal(infos[1]["terminal_observation"], info["final_obs"][1])
            assert infos[0]["episode"]["l"] == 5
            assert infos[0]["episode"]["r"] == info["final_info"]["score"][0]
    adapter.close()
    vector.close()


def test_options_of_some_cars_leave_the_start_of_the_others() -> None:
    from simulator.env.stable_baselines import StableBaselinesCars

    adapter = StableBaselinesCars(3, track="oval", start={"speed": 10.0})
    adapter.set_options([{}, {"speed": 5.0}, {"to_middle": 1.0}])
    adapter.reset()
    speeds = [adapter.cars.world(number).state.vx for number in range(3)]
    assert speeds == pytest.approx([10.0, 5.0, 10.0])
    adapter.close()


@pytest.mark.slow
def test_ppo_learns_to_keep_the_road_in_20_000_steps(tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, str(EXAMPLE), "20000", "32"],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=600,
    )
    assert done.returncode == 0, done.stderr
    first, last = (float(word) for word in done.stdout.split() if word[0] in "-0")
    assert last > first
    assert (tmp_path / "ppo.zip").is_file()
