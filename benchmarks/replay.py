"""Checks that random episodes give bit-equal results in other processes and in vector environments.

Run: `python benchmarks/replay.py [--episodes 100] [--json FILE]`; it takes about five minutes on
two cores. Claim: 100 episodes give bit-equal observations, rewards, states, true features and info
(a) in one process, (b) in another process that runs them in the opposite order, and (c) in parallel
in Gymnasium's `AsyncVectorEnv`. Track, lanes, traffic, start, control rate, controls, noise and
sensors of an episode are random; every fifth episode also has pictures in a random light. For each
episode the SHA-256 over all its steps is compared.
"""

import hashlib
import os
import struct
import sys
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import astuple, dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import Any

os.environ.setdefault("LP_NUM_THREADS", "1")

sys.path.insert(0, str(Path(__file__).parents[1]))

import gymnasium as gym
import numpy as np
from gymnasium.vector import AsyncVectorEnv

import simulator.env  # noqa: F401  (registers the names)
from benchmarks.claims.outcome import conclude, run_command
from simulator.camera.scene.light import KINDS
from simulator.track.catalogue import OWN_TRACKS

STEPS = 200
SEED = 20
PICTURES_EVERY = 5
BESIDE_EACH_OTHER = 4
SENSORS = ("range", "range_traffic", "v_x", "engine", "wheel_spin_rear_left")

Step = tuple[Any, float, bool, bool, dict[str, Any]]


@dataclass(frozen=True)
class Episode:
    """One episode: the options and the start of its environment, and the seed of its reset and of
    its actions."""

    number: int
    seed: int
    kind: str
    options: dict[str, Any]
    start: dict[str, float]


def plan(count: int) -> list[Episode]:
    """Return `count` random episodes. Each call returns the same episodes."""
    return [random_episode(number) for number in range(count)]


def random_episode(number: int) -> Episode:
    rng = np.random.default_rng([SEED, number])
    options: dict[str, Any] = {
        "track": str(rng.choice(sorted(path.stem for path in OWN_TRACKS.glob("*.toml")))),
        "lanes": int(rng.integers(1, 4)),
        "traffic": int(rng.integers(0, 13)),
        "frequency_hz": int(rng.choice([10, 20, 40, 50])),
        "controls": str(rng.choice(["steer", "full"])),
        "noise": bool(rng.random() < 0.5),
        "sensors": SENSORS,
        "sensor_noise": {"v_x": 0.3, "range": 0.2} if rng.random() < 0.5 else {},
    }
    kind = "state"
    if number % PICTURES_EVERY == PICTURES_EVERY - 1:
        kind = "pictures"
        options |= {"views": ("front", "rear:class", "chase"), "width": 140, "height": 105}
        options |= {"light": str(rng.choice(KINDS)), "light_seed": int(rng.integers(1000))}
    start = {
        "s": float(rng.uniform(0.0, 2000.0)),
        "to_middle": float(rng.uniform(-1.0, 1.0)),
        "angle": float(rng.normal(0.0, 0.1)),
        "speed": float(rng.uniform(0.0, 25.0)),
    }
    seed, kind = int(rng.integers(2**31)), f"{kind}, {options['controls']}"
    return Episode(number, seed, kind, options, start)


class Fingerprint(gym.Wrapper[Any, Any, Any, Any]):
    """Chooses the actions of an episode itself and hashes all results of its steps.

    `info["digest"]` is the SHA-256 so far. Steps after the end of the episode change nothing.
    """

    def __init__(self, env: gym.Env[Any, Any], episode: Episode) -> None:
        super().__init__(env)
        self._episode = episode
        self._end: Step | None = None

    def reset(self, **_: Any) -> tuple[Any, dict[str, Any]]:
        self._hash = hashlib.sha256()
        self._rng = np.random.default_rng([self._episode.seed, 1])
        self._end = None
        observation, self._info = self._told(
            *self.env.reset(seed=self._episode.seed, options=self._episode.start)
        )
        return observation, self._info

    def step(self, action: Any) -> Step:
        if self._end is not None:
            return self._end
        observation, reward, over, _, info = self.env.step(self._action(self._info))
        self._hash.update(struct.pack("<d?", reward, over))
        observation, self._info = self._told(observation, info)
        # The vector environment must go on until all episodes are over, so the end of an episode
        # changes only the digest.
        taken = observation, float(reward), False, False, self._info
        self._end = taken if over else None
        return taken

    def _action(self, info: dict[str, Any]) -> np.ndarray[Any, Any]:
        wheel = 2.0 * info["angle"] - 0.2 * info["to_middle"] + self._rng.normal(0.0, 0.2)
        others = self._rng.random(3) * (0.5, 0.1, 3.0) + (0.0, 0.0, 0.6)
        action = np.array([np.clip(wheel, -1.0, 1.0), *others], np.float32)
        return action if self.action_space.shape == (4,) else action[:1]

    def _told(self, observation: Any, info: dict[str, Any]) -> tuple[Any, dict[str, Any]]:
        world = self.unwrapped.world  # type: ignore[attr-defined]
        for part in parts(observation):
            self._hash.update(part)
        # repr of a float is exact: floats that differ in one bit have different texts.
        self._hash.update(repr((astuple(world.state), world.traffic.poses().tolist())).encode())
        self._hash.update(repr((world.features(), info)).encode())
        return observation, info | {"digest": self._hash.hexdigest()}


def parts(observation: Any) -> Iterator[bytes]:
    """Yield name and bytes of each array of an observation, in the order of the names."""
    for name in sorted(observation):
        yield name.encode() + observation[name].tobytes()


def maker(episode: Episode) -> Callable[[], gym.Env[Any, Any]]:
    def make() -> gym.Env[Any, Any]:
        env = gym.make("driverview/LateralControl-v0", **episode.options)
        return Fingerprint(env, episode)

    return make


def run_alone(episodes: list[Episode]) -> dict[int, str]:
    """Run the episodes one after another; return "STEPS DIGEST" by the episode's number."""
    digests = {}
    for episode in episodes:
        env = maker(episode)()
        env.reset()
        for _ in range(STEPS):
            info = env.step(None)[4]
        env.close()
        digests[episode.number] = f"{info['steps']} {info['digest']}"
    return digests


def run_beside(episodes: list[Episode]) -> dict[int, str]:
    """Run up to four episodes of the same kind at once in an AsyncVectorEnv.

    Returns "STEPS DIGEST" by the episode's number, like `run_alone`.
    """
    digests: dict[int, str] = {}
    for kind in sorted({episode.kind for episode in episodes}):
        alike = [episode for episode in episodes if episode.kind == kind]
        for first in range(0, len(alike), BESIDE_EACH_OTHER):
            group = alike[first : first + BESIDE_EACH_OTHER]
            # The episodes' observation spaces differ in their limits, which include the noise.
            vector = AsyncVectorEnv(
                [maker(episode) for episode in group], observation_mode="different"
            )
            vector.reset()
            nothing = vector.action_space.sample()  # ignored: the episodes choose their actions
            for _ in range(STEPS):
                *_, infos = vector.step(nothing)
            vector.close()
            for episode, *told in zip(group, infos["steps"], infos["digest"], strict=True):
                digests[episode.number] = " ".join(map(str, told))
            print(f"{len(digests)} of {len(episodes)} episodes in vectors", file=sys.stderr)
    return digests


def main(episodes: int = 100, json: Path | None = None) -> None:
    planned, started = plan(episodes), time.perf_counter()
    # The vector environments run first, because they fork this process, which must not have an
    # OpenGL context at that moment.
    beside = run_beside(planned)
    with ProcessPoolExecutor(2, mp_context=get_context("spawn")) as pool:
        forwards = pool.submit(run_alone, planned)
        backwards = pool.submit(run_alone, planned[::-1])
        alone, again = forwards.result(), backwards.result()
    different = {
        "another_process": [n for n in alone if alone[n] != again[n]],
        "async_vector": [n for n in alone if alone[n] != beside[n]],
    }
    reached = len(set(alone.values())) == len(planned) and not any(different.values())
    result = {
        "episodes": len(planned),
        "with_pictures": sum(episode.kind.startswith("pictures") for episode in planned),
        "distinct": len(set(alone.values())),
        "ended_early": sum(int(told.split()[0]) < STEPS for told in alone.values()),
        "steps": sum(int(told.split()[0]) for told in alone.values()),
        "seconds": round(time.perf_counter() - started, 1),
        "different": different,
        "reached": reached,
    }
    conclude(result, json, reached)


if __name__ == "__main__":
    run_command(main)
