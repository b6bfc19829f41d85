"""Environments step the same in every thread and in each kind of vector environment."""

import copy
import pickle
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.wrappers import RecordVideo

from simulator.camera.core.turns import ForkedRendererError
from simulator.env import NotCopyable  # registers the names, too

IMAGE_ID, STATE_ID = "driverview/DriverView-v0", "driverview/LateralControl-v0"
SMALL: dict[str, Any] = {"width": 64, "height": 48, "track": "oval"}
Images = list[np.ndarray[Any, Any]]


def make() -> gym.Env[Any, Any]:
    return gym.make(IMAGE_ID, **SMALL)


def actions(seed: int) -> Images:
    steering = np.random.default_rng(seed).uniform(-0.3, 0.3, (8, 1))
    return list(steering.astype(np.float32))


def drive(seed: int) -> Images:
    env = make()
    images = [env.reset(seed=seed)[0]["image"]]
    images += [env.step(action)[0]["image"] for action in actions(seed)]
    env.close()
    return images


@pytest.fixture(scope="module")
def expected() -> list[Images]:
    return [drive(seed) for seed in range(3)]


def test_image_environments_in_threads_equal_those_of_the_main_thread(
    expected: list[Images],
) -> None:
    with ThreadPoolExecutor(3) as pool:
        np.testing.assert_array_equal(list(pool.map(drive, range(3))), expected)


def test_an_image_environment_is_handed_from_thread_to_thread(expected: list[Images]) -> None:
    with ThreadPoolExecutor(1) as one, ThreadPoolExecutor(1) as another:
        env = one.submit(make).result()
        images = [env.reset(seed=0)[0]["image"]]
        for k, action in enumerate(actions(0)):
            pool = (one, another)[k % 2]
            step = pool.submit(env.step, action).result() if k % 3 else env.step(action)
            images.append(step[0]["image"])
        another.submit(env.close).result()
    np.testing.assert_array_equal(images, expected[0])


@pytest.mark.contacts
def test_worlds_in_threads_do_not_disturb_each_other() -> None:
    """This holds also while PyBullet computes contacts: all its clients are in one process."""

    def positions(seed: int) -> list[tuple[float, float, str | None]]:
        env = gym.make(STATE_ID, track="oval", lanes=2, traffic=4, controls="full", ends=())
        env.reset(seed=seed, options={"speed": 20.0})
        world = env.unwrapped.world  # type: ignore[attr-defined]
        states = []
        for _ in range(60):
            env.step(np.array([0.4, 0.5, 0.0, 2.0], np.float32))
            states.append((world.state.x, world.state.yaw, world.state.collision))
        env.close()
        assert "wall" in {collision for _, _, collision in states}
        return states

    alone = [positions(seed) for seed in range(4)]
    with ThreadPoolExecutor(4) as pool:
        assert list(pool.map(positions, range(4))) == alone


@pytest.mark.parametrize("shared_memory", [True, False])
def test_workers_forked_after_a_picture_raise_an_error(
    expected: list[Images], shared_memory: bool
) -> None:
    assert len(expected) == 3  # this process has drawn
    vector = gym.vector.AsyncVectorEnv([make], shared_memory=shared_memory, context="fork")
    with (
        pytest.raises(ForkedRendererError, match='context="spawn"'),
        pytest.warns(UserWarning, match="forked after its parent had drawn"),
    ):
        vector.reset(seed=0)
    vector.close(terminate=True)


VECTORS = """
import sys
import gymnasium as gym, numpy as np
import simulator.env
def make():
    return gym.make("driverview/DriverView-v0", width=64, height=48, track="oval")
def step(vector):
    vector.reset(seed=4)
    images = vector.step(np.array([[0.1]], np.float32))[0]["image"].copy()
    vector.close()
    return images
if __name__ == "__main__":
    processes = gym.vector.AsyncVectorEnv
    before = [
        step(processes([make], shared_memory=shared, context=start))
        for start, shared in (("fork", True), ("fork", False))
    ]
    right = step(gym.vector.SyncVectorEnv([make]))
    after = [
        step(processes([make], shared_memory=shared, context=start))
        for start, shared in (("forkserver", True), ("spawn", False))
    ]
    print([bool((each == right).all()) for each in before + after], right.std() > 10.0)
"""


@pytest.mark.extended
@pytest.mark.slow
def test_vector_environments_draw_the_same_in_every_kind_of_process(tmp_path: Path) -> None:
    script = tmp_path / "vectors.py"
    script.write_text(VECTORS)
    done = subprocess.run(
        [sys.executable, str(script)], capture_output=True, text=True, timeout=300
    )
    assert done.stdout.splitlines()[-1] == "[True, True, True, True] True", done.stderr


@pytest.mark.parametrize("copies", [copy.deepcopy, pickle.dumps])
@pytest.mark.parametrize("name", [IMAGE_ID, STATE_ID])
def test_environments_are_not_copied(name: str, copies: Any) -> None:
    env = gym.make(name, track="oval")
    with pytest.raises(NotCopyable, match="make another one with the same options"):
        copies(env)
    env.close()


def test_films_of_an_environment_stepped_in_a_thread(tmp_path: Path) -> None:
    import cv2

    film = tmp_path / "café au lait"
    env: gym.Env[Any, Any] = RecordVideo(
        gym.make(IMAGE_ID, render_mode="rgb_array", **SMALL), str(film), disable_logger=True
    )
    env.reset(seed=0)
    with ThreadPoolExecutor(1) as pool:
        for action in actions(0):
            pool.submit(env.step, action).result()
    env.close()
    (path,) = film.glob("*.mp4")
    video = cv2.VideoCapture(str(path))
    means = [video.read()[1].mean() for _ in range(9)]
    assert min(means) > 100.0
    assert max(means) - min(means) < 10.0
