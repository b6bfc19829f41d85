"""Many cars in one vector environment: the same numbers as single environments, bit for bit."""

from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode

from simulator.env.vector import LateralControlVector
from trackfeatures.errors import UserError

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
