"""Pictures of many cars: those of single environments bit for bit, and workers that die."""

import gc
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode

from simulator.camera.workers import pool
from simulator.camera.workers.pool import PictureWorkerError
from simulator.env.vector import DriverViewVector, LateralControlVector
from trackfeatures.errors import UserError

IMAGE_ID = "driverview/DriverView-v0"
SMALL: dict[str, Any] = {"width": 40, "height": 32, "track": "oval"}
FOUR: dict[str, Any] = {
    "lanes": [1, 2, 1, 2],
    "traffic": [0, 2, 0, 0],
    "light": ["clear", "clear", "rain", "clear"],
    "start": [{"s": 300.0 * k, "speed": 12.0} for k in range(4)],
}


def make_vector(count: int, **options: Any) -> DriverViewVector:
    vector = gym.make_vec(IMAGE_ID, count, vectorization_mode="vector_entry_point", **options)
    assert isinstance(vector, DriverViewVector)
    return vector


def processes(vector: LateralControlVector) -> list["subprocess.Popen[bytes]"]:
    """The processes that draw a vector's pictures."""
    return [worker.process for worker in vector._observer._pictures._pool._workers]


def shared_memories() -> int:
    """Number of memories for pictures that this process has open or mapped."""
    maps = Path("/proc/self/maps").read_text()
    opened = [str(each.resolve()) for each in Path("/proc/self/fd").iterdir()]
    return (maps + " ".join(opened)).count("driverview-pictures")


@pytest.fixture(scope="module")
def two_cars() -> Iterator[DriverViewVector]:
    vector = make_vector(2, workers=2, copy=False, max_episode_steps=3, **SMALL)
    yield vector
    vector.close()


EXTENDED = pytest.mark.extended


@pytest.mark.slow
@pytest.mark.parametrize(
    "mode",
    [AutoresetMode.NEXT_STEP, pytest.param(AutoresetMode.SAME_STEP, marks=EXTENDED)],
)
def test_pictures_and_states_equal_single_environments(mode: AutoresetMode) -> None:
    shared: dict[str, Any] = {
        **SMALL,
        "views": ("front", "rear:depth"),
        "sensors": ("v_x", "camera"),
        "sensor_noise": {"v_x": 0.5},
        "max_episode_steps": 12,
    }
    singles = [
        (
            lambda k=k: gym.make(
                IMAGE_ID,
                disable_env_checker=True,
                **{name: values[k] for name, values in FOUR.items()},
                **shared,
            )
        )
        for k in range(4)
    ]
    expected = gym.vector.SyncVectorEnv(singles, autoreset_mode=mode)
    vector = make_vector(4, workers=2, autoreset_mode=mode, **FOUR, **shared)
    assert vector.observation_space == expected.observation_space
    seen: list[tuple[Any, Any]] = [(vector.reset(seed=3)[0], expected.reset(seed=3)[0])]
    actions = np.random.default_rng(0).uniform(-0.3, 0.3, (30, 4, 1)).astype(np.float32)
    truncated = 0
    for step in range(30):
        found, right = vector.step(actions[step]), expected.step(actions[step])
        seen.append((found[0], right[0]))
        np.testing.assert_array_equal(found[3], right[3])
        truncated += int(found[3].sum())
        if "final_obs" in right[4]:
            for k in np.flatnonzero(right[4]["_final_obs"]):
                seen.append((found[4]["final_obs"][k], right[4]["final_obs"][k]))
        if step == 20:
            mask = np.array([True, False, True, False])
            again = [
                each.reset(seed=9, options={"reset_mask": mask, "s": 100.0})[0]
                for each in (vector, expected)
            ]
            seen.append((again[0], again[1]))
    assert truncated >= 6
    for number, (found, right) in enumerate(seen):
        assert set(found) == set(right) == {"state", "front", "rear:depth", "v_x", "camera"}
        for name in right:
            np.testing.assert_array_equal(found[name], right[name], f"{number} {name}", strict=True)
    assert len({picture[0].tobytes() for picture in (each[0]["front"] for each in seen)}) > 25
    vector.close()
    expected.close()


@pytest.mark.slow
def test_observations_view_the_shared_memory_only_without_copy(two_cars: DriverViewVector) -> None:
    first = two_cars.reset(seed=0, options={"speed": 10.0})[0]["image"]
    assert first.shape == (2, 32, 40, 3)
    assert first.std() > 10.0
    kept, still = first[1].copy(), np.zeros((2, 1), np.float32)
    second = two_cars.step(still)[0]["image"]
    assert np.shares_memory(first, second)
    assert (first[1] != kept).any()
    assert two_cars.observation_space["image"].contains(second)  # type: ignore[index]
    copying = make_vector(1, **SMALL)
    one, two = (copying.reset(seed=0)[0]["image"] for _ in range(2))
    assert not np.shares_memory(one, two)
    copying.close()


@pytest.mark.slow
@pytest.mark.parametrize("fate", [signal.SIGKILL, pytest.param(signal.SIGSEGV, marks=EXTENDED)])
def test_a_worker_that_dies_is_named_and_reset_starts_others(
    two_cars: DriverViewVector, fate: signal.Signals
) -> None:
    before = two_cars.reset(seed=0)[0]["image"].copy()
    killed, other = processes(two_cars)
    killed.send_signal(fate)
    killed.wait(60.0)
    started = time.monotonic()
    with pytest.raises(
        PictureWorkerError,
        match=rf"^picture worker 0 of 2 \(process {killed.pid}, car 0\) was killed by {fate.name}",
    ):
        two_cars.step(np.zeros((2, 1), np.float32))
    assert time.monotonic() - started < 60.0
    assert other.returncode == -signal.SIGKILL
    assert processes(two_cars) == []
    with pytest.raises(gym.error.ResetNeeded, match="call reset"):
        two_cars.step(np.zeros((2, 1), np.float32))
    np.testing.assert_array_equal(two_cars.reset(seed=0)[0]["image"], before)


@pytest.mark.extended
def test_new_workers_draw_all_cars(two_cars: DriverViewVector) -> None:
    before = two_cars.reset(seed=0)[0]["image"].copy()
    two_cars._observer._pictures._pool._owner = -1  # as in a forked child
    only_one = {"reset_mask": np.array([False, True])}
    after = two_cars.reset(seed=5, options=only_one)[0]["image"]
    assert not np.shares_memory(after, before)
    np.testing.assert_array_equal(after[0], before[0])


@pytest.mark.extended
def test_a_worker_that_hangs_is_named(
    two_cars: DriverViewVector, monkeypatch: pytest.MonkeyPatch
) -> None:
    two_cars.reset(seed=0)
    processes(two_cars)[1].send_signal(signal.SIGSTOP)
    monkeypatch.setattr(pool, "SILENCE_S", 1)
    with pytest.raises(PictureWorkerError, match=r"^picture worker 1 of 2 .*, car 1\) drew no pic"):
        two_cars.step(np.zeros((2, 1), np.float32))


@pytest.mark.slow
def test_workers_and_memory_are_gone_after_close_and_garbage_collection() -> None:
    before = shared_memories()
    for end in ("close", "drop"):
        vector = make_vector(1, **SMALL)
        vector.reset(seed=0)
        (worker,) = processes(vector)
        assert shared_memories() > before
        if end == "close":
            vector.close()
            vector.close()
        del vector
        gc.collect()
        assert worker.returncode == -signal.SIGKILL
        assert shared_memories() == before


SCRIPT = """
import gymnasium, numpy as np
import simulator.env
vector = gymnasium.make_vec("driverview/DriverView-v0", 2, vectorization_mode="vector_entry_point",
    width=40, height=32, track="oval", workers=2)
vector.reset(seed=0)
print(*[each.process.pid for each in vector._observer._pictures._pool._workers], flush=True)
while True:
    vector.step(np.zeros((2, 1), np.float32))
"""


@pytest.mark.slow
@pytest.mark.parametrize("fate", [signal.SIGINT, pytest.param(signal.SIGKILL, marks=EXTENDED)])
def test_workers_end_with_their_process(fate: signal.Signals, tmp_path: Path) -> None:
    """The script has no `if __name__ == "__main__"`: workers do not import it."""
    script = tmp_path / "script.py"
    script.write_text(SCRIPT)
    parent = subprocess.Popen(
        [sys.executable, str(script)], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    assert parent.stdout is not None
    workers = [int(word) for word in parent.stdout.readline().split()]
    assert len(workers) == 2
    time.sleep(0.2)
    parent.send_signal(fate)
    _, told = parent.communicate(timeout=60.0)
    assert ("KeyboardInterrupt" in told) == (fate == signal.SIGINT)
    assert told.count("Traceback") <= 1
    until = time.monotonic() + 60.0
    while any(Path(f"/proc/{worker}").exists() for worker in workers):
        assert time.monotonic() < until
        time.sleep(0.05)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"workers": 0}, "^workers is 0; give a whole number of 1 or more"),
        ({"workers": 1.5}, "^workers is 1.5"),
        ({"light": ["clear", "moonlight", "clear"]}, "^car 1: .*moonlight"),
        ({"light_seed": [1, 2]}, "^light_seed is a list of 2 for 3 cars"),
        ({"views": ("front", "sideways")}, "unknown camera view 'sideways'"),
    ],
)
def test_bad_options_are_refused(options: dict[str, Any], message: str) -> None:
    with pytest.raises(UserError, match=message):
        make_vector(3, **{**SMALL, **options})
