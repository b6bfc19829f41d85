"""The Gymnasium environments: checker, spaces, reward, termination, seeds, vectors, errors."""

import math
import re
import subprocess
import sys
import warnings
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

import simulator.env  # registers the names
from simulator.env.reward import quadratic_reward, step_reward
from simulator.sensors import Sensor
from simulator.vehicle.car import CarParameters
from trackfeatures.errors import UserError

STATE_ID = "driverview/LateralControl-v0"
IMAGE_ID = "driverview/DriverView-v0"
SMALL = {"width": 64, "height": 48}


def make(**options: Any) -> gym.Env[Any, Any]:
    return gym.make(STATE_ID, **{"track": "circuit", **options})


def steer(value: float) -> np.ndarray[Any, Any]:
    return np.array([value], np.float32)


@pytest.mark.parametrize(
    ("name", "options"),
    [
        (STATE_ID, {"traffic": 2, "lanes": 2, "noise": True}),
        (STATE_ID, {"sensors": ("range", "v_x"), "sensor_noise": {"range": 0.1}}),
        (IMAGE_ID, {"views": ("front", "rear:depth", "front:class"), **SMALL}),
        (IMAGE_ID, {"observation": "image", "render_mode": "rgb_array", **SMALL}),
    ],
)
def test_env_checker_passes_without_a_warning(name: str, options: dict[str, Any]) -> None:
    env = gym.make(name, track="circuit", **options)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(env.unwrapped)
    env.close()


def test_env_checker_warns_only_about_the_gear_range() -> None:
    env = make(controls="full")
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        check_env(env.unwrapped)
    assert ["normalized space" in str(warning.message) for warning in told] == [True]
    env.close()


def test_observation_equals_the_papers_state_vector() -> None:
    env = make()
    observation, _ = env.reset(
        seed=0, options={"s": 100.0, "to_middle": 1.2, "angle": -0.3, "speed": 10.0}
    )
    world = env.unwrapped.world  # type: ignore[attr-defined]
    half_width = world.road.half_width
    heading = np.eye(3)[int(world.features().heading)]
    expected = [1.2 / half_width, -0.3 / math.pi, 36.0 / 75.0, 0.0, *heading]
    np.testing.assert_allclose(observation, expected, atol=1e-6)
    assert observation.dtype == np.float32
    env.close()


def test_throttle_and_gear_are_constant_and_score_sums_rewards() -> None:
    env = make()
    env.reset(seed=1)
    total = 0.0
    info: dict[str, Any] = {}
    for _ in range(120):
        state = env.unwrapped.world.state  # type: ignore[attr-defined]
        wheel = -(state.to_middle - 2.0 * state.angle)
        _, reward, ended, cut, info = env.step(steer(min(max(wheel, -1.0), 1.0)))
        total += float(reward)
        assert not ended
        assert not cut
    state = env.unwrapped.world.state  # type: ignore[attr-defined]
    assert state.gear == 1
    assert info["score"] == pytest.approx(total)
    assert (info["steps"], info["ended"]) == (120, "")
    assert 15.0 < info["speed_kmh"] < 30.0
    env.close()


def test_reward_equals_hand_computed_values() -> None:
    assert step_reward(0.0, 0.0, 5.0, ended=False) == 1.0
    expected = math.cos(0.2) - math.sin(0.2) - 0.3
    assert step_reward(-0.2, 1.5, 5.0, ended=False) == pytest.approx(expected)
    assert step_reward(0.2, 1.5, 5.0, False, 0.5) == pytest.approx(
        math.cos(0.2) - 0.5 * math.sin(0.2) - 0.3
    )
    assert step_reward(1.6, 0.0, 5.0, ended=False) == -2.0
    assert step_reward(0.0, 0.0, 5.0, ended=True) == -2.0


def test_the_papers_quadratic_reward() -> None:
    expected = -(0.3 * 0.01 + 0.0004 + 0.03 * (0.5 * CarParameters.steering_lock) ** 2)
    assert quadratic_reward(-0.1, 0.02, -0.5, ended=False) == pytest.approx(expected)
    assert quadratic_reward(0.0, 0.0, 0.0, ended=True) == -2.0


def test_leaving_the_track_ends_the_episode_with_minus_two() -> None:
    env = make()
    env.reset(seed=0, options={"s": 60.0, "speed": 15.0})
    for _ in range(200):
        _, reward, ended, _, info = env.step(steer(0.3))
        if ended:
            break
    assert ended
    assert reward == -2.0
    assert info["ended"] == "off_track"
    env.close()


@pytest.mark.contacts
def test_a_collision_ends_the_episode_with_minus_two() -> None:
    env = make(track="oval", traffic=1, controls="full")
    _, info = env.reset(seed=0, options={"speed": 20.0})
    for _ in range(1500):
        wheel = info["angle"] - 0.1 * info["to_middle"]
        action = np.clip([wheel, 0.3, 0.0, 2.0], -1.0, 2.0).astype(np.float32)
        _, reward, ended, _, info = env.step(action)
        if ended:
            break
    assert ended
    assert (reward, info["ended"], info["collision"]) == (-2.0, "collision", "traffic")
    env.close()


@pytest.mark.parametrize("frequency_hz", [10, 50])
def test_render_fps_is_the_control_rate(frequency_hz: int) -> None:
    env = make(frequency_hz=frequency_hz)
    assert env.metadata["render_fps"] == frequency_hz
    env.close()
    assert simulator.env.LateralControl.metadata["render_fps"] == 20


def test_an_episode_is_truncated_after_max_episode_steps() -> None:
    spec = gym.spec(STATE_ID)
    assert spec.max_episode_steps == 6500
    env = make(max_episode_steps=3)
    env.reset(seed=0)
    assert [env.step(steer(0.0))[2:4] for _ in range(3)] == [(False, c) for c in (0, 0, 1)]
    env.close()


def test_state_noise_is_0_05_and_seeded() -> None:
    quiet, noisy = make(), make(noise=True)
    base, _ = quiet.reset(seed=3)
    states = [noisy.reset(seed=seed)[0] for seed in range(200)]
    assert np.std(np.array(states) - base) == pytest.approx(0.05, rel=0.1)
    np.testing.assert_array_equal(noisy.reset(seed=3)[0], states[3])
    quiet.close()
    noisy.close()


def test_full_controls_shift_gears_and_brake() -> None:
    env = make(controls="full")
    env.reset(seed=0, options={"s": 30.0, "speed": 15.0})
    for _ in range(20):
        _, _, _, _, info = env.step(np.array([0.0, 0.0, 1.0, 2.4], np.float32))
    assert info["speed_kmh"] < 10.0
    assert env.unwrapped.world.state.gear == 2  # type: ignore[attr-defined]
    env.close()


def test_a_vector_environment_equals_two_single_environments() -> None:
    vector = gym.make_vec(STATE_ID, num_envs=2, vectorization_mode="async", track="circuit")
    assert isinstance(vector, gym.vector.AsyncVectorEnv)
    observations, _ = vector.reset(seed=[4, 5])
    for _ in range(30):
        observations, *_ = vector.step(np.array([[0.02], [-0.02]], np.float32))
    vector.close()
    for row, action in ((0, 0.02), (1, -0.02)):
        env = make()
        alone, _ = env.reset(seed=4 + row)
        for _ in range(30):
            alone, *_ = env.step(steer(action))
        np.testing.assert_array_equal(observations[row], alone)
        env.close()


def test_start_options_at_their_bounds_and_of_other_kinds() -> None:
    env = make(lane_width=4.1)
    world = env.unwrapped.world  # type: ignore[attr-defined]
    edge = world.road.edge
    for given in (np.nextafter(np.float32(edge), np.float32(99.0)), -edge - 1e-6, edge):
        env.reset(seed=0, options={"to_middle": given})
        assert abs(world.state.to_middle) == pytest.approx(edge, abs=1e-9)
    given_starts: list[dict[str, Any]] = [
        {"s": np.float32(world.road.track.length_m), "speed": np.float32(150.00001)},
        {"s": None, "angle": np.float64(math.pi), "to_middle": 1},
    ]
    for options in given_starts:
        observation, _ = env.reset(seed=0, options=options)
        assert env.observation_space.contains(observation)
    # The values are rounded to float32 once, not in each formula.
    env.reset(seed=0, options={"angle": np.float32(0.1), "to_middle": np.float32(0.3)})
    taken = world.state
    env.reset(
        seed=0, options={"angle": float(np.float32(0.1)), "to_middle": float(np.float32(0.3))}
    )
    assert world.state == taken
    refused: list[tuple[dict[Any, Any], str]] = [
        ({"to_middle": edge + 1e-3}, "the road ends"),
        ({"speed": 150.001}, "give m/s between"),
        ({"angle": "left"}, "reset got angle = 'left'; give a number"),
        ({"to_middle": math.nan}, "give a finite number"),
        ({"s": math.inf}, "give a finite number"),
        ({1: 2.0}, "unknown options"),
        ({"velocity": 3.0}, "velocity"),
        ({"speed": (5.0, 1.0)}, r"speed is \(5.0, 1.0\); give a finite number, or a range"),
        ({"speed": (1.0, 2.0, 3.0)}, "give a finite number, or a range"),
        ({"s": (0.0, math.inf)}, "give a finite number, or a range"),
        ({"angle": ()}, "give a finite number, or a range"),
        ({"to_middle": (0.0, edge + 1.0)}, "the road ends"),
        ([1, 2], r"options is \[1, 2\]; give a dict"),  # type: ignore[list-item]
    ]
    for bad, message in refused:
        with pytest.raises(UserError, match=message):
            env.reset(seed=0, options=bad)
    env.close()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"track": "no-such-track"}, "no-such-track"),
        ({"lanes": 4}, "4 lanes"),
        ({"frequency_hz": 30}, "30 Hz"),
        ({"noise": -1.0}, "noise"),
        ({"noise": math.nan}, "noise"),
        ({"controls": "feet"}, "controls"),
        ({"colour": "red"}, "colour"),
        ({"trafic": 3}, "did you mean 'traffic'"),
        ({"lambda_": math.nan}, "lambda_"),
        ({"reward": 3.0}, "reward is 3.0"),
        ({"reward": lambda state, road, ending: 0.0, "lambda_": 2.0}, "lambda_"),
        ({"ends": ("off_track", "boredom")}, "boredom"),
        ({"ends": "off_track"}, "give a list"),
        ({"traffic": 50}, "50 traffic cars"),
        ({"light": "bogus"}, "unknown light 'bogus'"),
        ({"width": 4}, "picture size 4"),
        ({"render_view": "inside"}, "render_view is 'inside'"),
        ({"observation": "smell"}, "observation is 'smell'"),
        ({"observation": "image", "views": ()}, "one picture"),
        ({"observation": "state", "views": ("front",)}, "views are part"),
        ({"observation": "image", "sensors": ("v_x",)}, "sensors are part"),
        ({"views": ("below",)}, "unknown camera view 'below'"),
        ({"views": ("front:heat",)}, "unknown kind of picture 'heat'"),
        ({"views": "front"}, "give a list"),
        ({"views": ("front", "front")}, "once"),
        ({"sensors": ("lidar",)}, "unknown sensor 'lidar'"),
        ({"sensors": ("v_x", "v_x")}, "share a name"),
        ({"sensors": ("v_x",), "sensor_noise": {"v_y": 1.0}}, "noise is set for"),
        ({"sensors": (Sensor("state", "", lambda world: 0.0),)}, "named like"),
        ({"track": None}, "track is None; give a name"),
        ({"track": ("oval", "town")}, "track is ('oval', 'town')"),
        ({"lanes": [1, 2]}, "a road of [1, 2] lanes"),
        ({"lanes": (1.5, 3)}, "a road of 1.5 lanes"),
        ({"lane_width": "wide"}, "lane_width is 'wide'; give a finite number"),
        ({"road_seed": -1}, "road_seed is -1; give a whole number of 0 or more"),
        ({"start": None}, "start is None; give a dict"),
        ({"frequency_hz": 0}, "frequency_hz is 0; give a whole number of 1 or more"),
        ({"frequency_hz": "20"}, "frequency_hz is '20'"),
        ({"controls": ["steer"]}, "controls is ['steer']"),
        ({"noise": [0.1]}, "noise is [0.1]; give a standard deviation"),
        ({"sensors": 3}, "sensors is 3; give a list"),
        ({"sensor_noise": 0.1}, "sensor_noise is 0.1; give a dict"),
        ({"ends": None}, "ends is None; give a list"),
        ({"lambda_": "1"}, "lambda_ is '1'; give a finite weight"),
        ({"height": 48.5}, "height is 48.5; give a whole number"),
        ({"light_seed": -1}, "light_seed is -1; give a whole number of 0 or more"),
        ({"mount": "roof"}, "mount is 'roof'; give a CameraParameters"),
    ],
)
def test_bad_options_are_refused(options: dict[str, Any], message: str) -> None:
    with pytest.raises(UserError, match=re.escape(message)):
        make(**options)


def test_an_unknown_render_mode_is_refused() -> None:
    with pytest.raises(UserError, match="render_mode is 'ansi'"):
        simulator.env.LateralControl(render_mode="ansi")


def test_a_step_without_an_episode_is_refused() -> None:
    env = simulator.env.LateralControl("circuit")
    with pytest.raises(UserError, match="call reset"):
        env.step(steer(0.0))
    env.reset(seed=0, options={"s": 60.0, "speed": 15.0})
    while not env.step(steer(0.5))[2]:
        pass
    # Gymnasium's own wrapper raises the same class, so that callers catch one error.
    with pytest.raises(gym.error.ResetNeeded, match="after each episode"):
        env.step(steer(0.0))
    env.reset(seed=0)
    env.step(steer(0.0))
    env.close()
    with pytest.raises(UserError, match="call reset"):
        env.step(steer(0.0))
    with pytest.raises(UserError, match="closed"):
        env.reset(seed=0)


@pytest.mark.parametrize(
    "code",
    [
        "import gymnasium, simulator; print(gymnasium.spec('driverview/DriverView-v0').id)",
        "import gymnasium as g; e = g.make('simulator.env:driverview/DriverView-v0', width=64);"
        "print(e.spec.id)",
        "import gymnasium as g; e = g.make_vec('simulator.env:driverview/DriverView-v0', 2,"
        "vectorization_mode='sync'); print(e.spec.id)",
    ],
)
def test_environments_are_registered_by_import_or_by_module_prefix(code: str) -> None:
    result = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )
    assert result.stdout.splitlines()[-1] == IMAGE_ID


def test_driver_view_observes_image_and_state() -> None:
    env = gym.make(IMAGE_ID, track="circuit", lanes=2, width=140, height=105)
    try:
        observation, _ = env.reset(seed=0)
        assert env.observation_space.contains(observation)
        assert observation["image"].shape == (105, 140, 3)
        assert observation["image"].std() > 10.0  # not a blank image
        moved, *_ = env.step(steer(0.0))
        assert moved["state"].shape == (7,)
    finally:
        env.close()
