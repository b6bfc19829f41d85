"""Many cars in one vector environment: the same numbers as single environments, bit for bit."""

from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode

from simulator.env.vector import LateralControlVector

ID = "driverview/LateralControl-v0"
TRACKS = ("circuit", "oval", "mountain-pass", "town", "forest")
CARS = 64
LIST: dict[str, Any] = {
    "track": [TRACKS[k % 5] for k in range(CARS)],
    "lanes": [1 + k % 3 for k in range(CARS)],
    "lane_width": [None if k % 4 else 3.2 for k in range(CARS)],
    "traffic": [2 if k % 16 == 3 else 0 for k in range(CARS)],
    "friction": [(0.7, 1.2) if k % 2 else 1.0 for k in range(CARS)],
    "mass": [1.0 + 0.01 * (k % 7) for k in range(CARS)],
    "start": [{"speed": (5.0, 20.0), "s": 13.0 * k} for k in range(CARS)],
}


def make_vector(count: int, **options: Any) -> LateralControlVector:
    vector = gym.make_vec(ID, count, vectorization_mode="vector_entry_point", **options)
    assert isinstance(vector, LateralControlVector)
    return vector


def make_single(number: int, options: dict[str, Any], **shared: Any) -> gym.Env[Any, Any]:
    own = {name: values[number] for name, values in options.items()}
    return gym.make(ID, disable_env_checker=True, **own, **shared)


def steering(observations: Any, errors: Any, rng: np.random.Generator) -> Any:
    """Steer to the middle, with slow errors (N,) so large that some of the cars leave the road."""
    errors[:] = 0.95 * errors + rng.normal(0.0, 0.12, len(errors))
    wheel = 4.0 * observations[:, 1] - 0.9 * observations[:, 0] + errors
    return np.clip(wheel, -1.0, 1.0).astype(np.float32)[:, None]


def assert_equal(one: Any, other: Any, path: str = "") -> None:
    """Equal keys, types and bits, through all levels of dicts."""
    if isinstance(one, dict):
        assert set(one) == set(other), path
        for name in one:
            assert_equal(one[name], other[name], f"{path}/{name}")
    elif isinstance(one, tuple) or (isinstance(one, np.ndarray) and one.dtype == object):
        for k, (a, b) in enumerate(zip(one, other, strict=True)):
            assert_equal(a, b, f"{path}[{k}]")
    else:
        assert type(one) is type(other), path
        np.testing.assert_array_equal(one, other, err_msg=path, strict=isinstance(one, np.ndarray))


@pytest.mark.contacts
@pytest.mark.parametrize(
    ("steps", "longest"), [(120, 50), pytest.param(2000, 700, marks=pytest.mark.extended)]
)
def test_64_cars_on_five_tracks_equal_single_environments(steps: int, longest: int) -> None:
    vector = make_vector(CARS, threads=3, max_episode_steps=longest, **LIST)
    rng, errors = np.random.default_rng(1), np.linspace(-4.0, 4.0, CARS)
    seeds = [100 + 7 * k for k in range(CARS)]
    observations, _ = vector.reset(seed=seeds)
    shown = np.zeros((steps + 1, CARS, 7), np.float32)
    told = np.zeros((steps, CARS, 5))
    actions = np.zeros((steps, CARS, 1), np.float32)
    shown[0] = observations
    for step in range(steps):
        actions[step] = steering(shown[step], errors, rng)
        shown[step + 1], *rest, info = vector.step(actions[step])
        told[step] = np.column_stack((*rest, info["score"], info["s"]))
    vector.close()
    assert told[:, :, 1].sum() > 10  # episodes that ended,
    assert told[:, :, 2].sum() > 60  # and that were cut off
    for number in range(CARS):
        env = make_single(number, LIST, max_episode_steps=longest)
        observation, info = env.reset(seed=seeds[number])
        heard: list[Any] = []
        seen: list[Any] = [observation]
        over: Any = False
        for step in range(steps):
            if over:
                observation, info = env.reset()
                heard.append((0.0, False, False, info["score"], info["s"]))
            else:
                observation, reward, ended, cut, info = env.step(actions[step, number])
                heard.append((reward, ended, cut, info["score"], info["s"]))
            over = heard[-1][1] or heard[-1][2]
            seen.append(observation)
        env.close()
        np.testing.assert_array_equal(shown[:, number], seen, err_msg=f"car {number}")
        np.testing.assert_array_equal(told[:, number], heard, err_msg=f"car {number}")


@pytest.mark.parametrize("mode", [AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP])
@pytest.mark.parametrize(
    "shared",
    [
        {},
        {"noise": True, "sensors": ("range", "v_x"), "sensor_noise": {"v_x": 0.5, "range": 0.1}},
        {"sensors": ["range"], "controls": "full", "frequency_hz": 10},
        {"ends": ("collision",), "reward": lambda state, road, ending: state.to_middle},
    ],
)
@pytest.mark.contacts
def test_everything_equals_gymnasiums_vector_of_single_environments(
    mode: AutoresetMode, shared: dict[str, Any]
) -> None:
    count, options = 5, {"max_episode_steps": 40, **shared}
    lists = {name: values[:count] for name, values in LIST.items()}
    expected = gym.vector.SyncVectorEnv(
        [partial(make_single, k, lists, **options) for k in range(count)], autoreset_mode=mode
    )
    vector = make_vector(count, autoreset_mode=mode, threads=2, **lists, **options)
    assert vector.observation_space == expected.observation_space
    assert vector.action_space == expected.action_space
    assert vector.metadata == expected.metadata
    assert_equal(vector.reset(seed=3), expected.reset(seed=3))
    rng, ended = np.random.default_rng(0), 0
    for step in range(100):
        actions = rng.uniform(-0.5, 0.5, (count, 1)).astype(np.float32)
        if "controls" in shared:
            actions = np.hstack((actions, np.tile([[0.3, 0.0, 2.4]], (count, 1)))).astype("f4")
        found = vector.step(actions)
        assert_equal(found, expected.step(actions), f"step {step}")
        ended += int(found[2].sum() + found[3].sum())
        if step == 60:
            mask = np.arange(count) % 2 == 0
            some = {"reset_mask": mask, "s": 50.0, "to_middle": 0.5}
            one, other = (each.reset(seed=9, options=dict(some)) for each in (vector, expected))
            assert_equal(one, other)
    assert ended > 5
    vector.close()
    expected.close()


def test_threads_and_number_of_cars_change_nothing() -> None:
    seen = []
    for count, threads in ((6, 1), (6, 4), (4, 2)):
        vector = make_vector(count, threads=threads, track="town", friction=(0.8, 1.0))
        observations, _ = vector.reset(seed=5)
        for step in range(40):
            actions = np.linspace(-0.4, 0.4, 6)[:count, None] * np.cos(step)
            observations, *_ = vector.step(actions)
        seen.append(observations[:4])
        vector.close()
    np.testing.assert_array_equal(seen[0], seen[1])
    np.testing.assert_array_equal(seen[0], seen[2])


def test_ranges_and_random_roads_are_drawn_anew_in_each_episode() -> None:
    options: dict[str, Any] = {
        "track": "random",
        "lanes": (1, 3),
        "lane_width": (3.0, 4.0),
        "friction": (0.5, 1.5),
        "mass": (0.9, 1.1),
        "start": {"to_middle": (-1.0, 1.0), "speed": 10.0},
    }
    env = gym.make(ID, **options)
    drawn = []
    for seed in (1, None, None, None, None, None):
        _, info = env.reset(seed=seed, options={"s": (0.0, 500.0)})
        world = env.unwrapped.world  # type: ignore[attr-defined]
        assert world.car.inertia[2] / world.car.mass == pytest.approx(1113.0 / 1150.0)
        road, car = world.road, world.car
        row = road.track.name, road.lanes, road.lane_width, car.friction, car.mass
        drawn.append((*row, info["to_middle"], info["s"]))
        assert info["speed_kmh"] == pytest.approx(36.0)
    env.close()
    names, lanes, widths, frictions, masses, offsets, places = zip(*drawn, strict=True)
    assert all(name.startswith("random:") for name in names)
    assert len(set(names)) > 4
    assert set(lanes) <= {1, 2, 3}
    assert len(set(lanes)) > 1
    assert all(3.0 <= width <= 4.0 and width == round(width, 1) for width in widths)
    assert all(0.8 <= friction <= 2.4 for friction in frictions)
    assert all(1035.0 <= mass <= 1265.0 for mass in masses)
    assert all(-1.01 <= offset <= 1.01 for offset in offsets)
    assert all(0.0 <= place <= 500.1 for place in places)
    for values in (frictions, masses, offsets, places):
        assert len(set(values)) == 6
    vector = make_vector(2, **options)
    _, info = vector.reset(seed=[0, 1], options={"s": [(0.0, 500.0), (0.0, 500.0)]})
    assert info["s"][1] == places[0]
    vector.close()


def test_less_grip_lengthens_the_way_to_stop() -> None:
    options: dict[str, Any] = {"friction": [1.0, 0.5], "controls": "full", "track": "oval"}
    vector = make_vector(2, **options)
    _, info = vector.reset(seed=0, options={"s": 30.0, "speed": 15.0})
    start = info["s"]
    while info["speed_kmh"].max() > 1.0:
        *_, info = vector.step(np.tile([[0.0, 0.0, 1.0, 0.0]], (2, 1)))
    way = info["s"] - start
    vector.close()
    assert 1.6 < way[1] / way[0] < 2.2


def test_without_autoreset_cars_are_reset_by_mask() -> None:
    vector = make_vector(2, autoreset_mode="Disabled", max_episode_steps=2)
    vector.reset(seed=0, options={"speed": [10.0, 0.0]})
    actions = np.zeros((2, 1), np.float32)
    vector.step(actions)
    vector.reset(options={"reset_mask": np.array([False, True])})
    _, _, _, truncated, info = vector.step(actions)
    assert (truncated.tolist(), info["steps"].tolist()) == ([True, False], [2, 1])
    with pytest.raises(gym.error.ResetNeeded, match="the episodes of cars 0 are over"):
        vector.step(actions)
    vector.reset(options={"reset_mask": truncated})
    assert vector.step(actions)[4]["steps"].tolist() == [1, 2]
    vector.close()


def test_gymnasiums_vector_wrappers_run_on_it() -> None:
    vector: Any = gym.wrappers.vector.RecordEpisodeStatistics(
        make_vector(3, max_episode_steps=20, noise=True)
    )
    vector = gym.wrappers.vector.NormalizeReward(gym.wrappers.vector.ClipAction(vector))
    observations, _ = vector.reset(seed=0)
    lengths: list[int] = []
    for _ in range(50):
        assert vector.observation_space.contains(observations)
        observations, *_, info = vector.step(vector.action_space.sample())
        lengths += info["episode"]["l"][info["_episode"]].tolist() if "episode" in info else []
    assert len(lengths) >= 6
    assert max(lengths) == 20
    vector.close()


@pytest.mark.slow
def test_views_and_frames_are_those_of_the_single_environment() -> None:
    shown: dict[str, Any] = {"render_mode": "rgb_array", "width": 64, "height": 48}
    vector = make_vector(1, track="oval", views=("front",), **shown)
    observations, _ = vector.reset(seed=0)
    assert vector.observation_space.contains(observations)
    (frame,) = vector.render()
    vector.close()
    np.testing.assert_array_equal(frame, observations["image"][0])
    env = gym.make(ID, track="oval", **shown)
    env.reset(seed=0)
    np.testing.assert_array_equal(frame, env.render())
    env.close()
