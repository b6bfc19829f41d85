"""Measures steps per second of the state environment, CarRacing-v3 and highway-env's racetrack-v0.

Run: `python benchmarks/state_env.py [--json FILE]`; it takes about two minutes on two cores.
Claims, on one core with 19 range beams in every step: at least 4,000 steps per second, 20 times as
many as CarRacing-v3 and 40 times as many as racetrack-v0. The environments take turns in one
process pinned to one core. A figure is the median over the turns of the steps per second of
processor time, without resets. Before these measurements, the beams of a short drive are compared
with a brute-force computation (limit 0.02 m). Vector environments of two environments each are
timed by wall time on two cores.
"""

import os
import statistics
import sys
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

os.environ.update(OMP_NUM_THREADS="1", SDL_VIDEODRIVER="dummy")
sys.path.insert(0, str(Path(__file__).parents[1]))  # to import from tests

import gymnasium as gym
import highway_env  # noqa: F401  (registers racetrack-v0)
import numpy as np

import simulator.env
from benchmarks.claims.outcome import conclude, run_command
from simulator.sensors.beams import BEAM_ANGLES
from tests.simulator.oracles import BruteForce

CLAIMS = {"steps_per_second": 4000.0, "times_car_racing": 20.0, "times_racetrack": 40.0}
BEAMS_WITHIN_M = 0.02
TURNS = 5
STEPS = {"driverview": 4000, "CarRacing-v3": 200, "racetrack-v0": 100}
CHECKED_STEPS = 500
VECTOR_STEPS = 3000

Action = np.ndarray[Any, Any]
Policy = Callable[[dict[str, Any]], Action]


def make(**options: Any) -> gym.Env[Any, Any]:
    """Make the state environment that is compared. Its observation is the paper's state and 19
    range beams."""
    name = "driverview/LateralControl-v0"
    return gym.make(name, track="circuit", sensors=("range",), **options)


def steering(info: dict[str, Any]) -> Action:
    """Return the action that steers along the centre line. `info` is the info of one environment or
    of a vector environment.

    The shape of the action is (1,) or, for a vector environment of N, (N, 1).
    """
    wheel = np.clip(2.0 * info["angle"] - 0.2 * info["to_middle"], -1.0, 1.0)
    return np.asarray(wheel, np.float32).reshape(*np.shape(wheel), 1)


def constant(*values: float) -> Policy:
    action = np.array(values, np.float32)
    return lambda info: action


def steps_per_second(env: gym.Env[Any, Any], policy: Policy, steps: int, seed: int) -> float:
    """Return the steps per second of processor time of this process. The time includes the policy,
    but not the resets."""
    _, info = env.reset(seed=seed)
    spent, started = 0.0, time.process_time()
    for _ in range(steps):
        _, _, ended, cut, info = env.step(policy(info))
        if ended or cut:
            spent += time.process_time() - started
            _, info = env.reset()
            started = time.process_time()
    return steps / (spent + time.process_time() - started)


def beams_error(steps: int) -> float:
    """Return the largest difference in m between the range beams and the brute-force computation in
    a drive of `steps` steps."""
    env = make()
    unwrapped = env.unwrapped
    assert isinstance(unwrapped, simulator.env.LateralControl)
    oracle = BruteForce(unwrapped.world.road)
    _, info = env.reset(seed=0)
    worst = 0.0
    for _ in range(steps):
        observation, _, _, _, info = env.step(steering(info))
        now = unwrapped.world.state
        expected = oracle.distances(now.x, now.y, now.yaw, BEAM_ANGLES)
        worst = max(worst, float(np.max(np.abs(observation["range"] - expected))))
    env.close()
    return worst


def compare() -> dict[str, float]:
    """Return the median steps per second of processor time of each environment. The environments
    take turns."""
    contestants: dict[str, tuple[gym.Env[Any, Any], Policy, int]] = {
        f"driverview, {cars} cars": (make(traffic=cars, lanes=3), steering, STEPS["driverview"])
        for cars in (0, 6, 12)
    }
    bare = gym.make("driverview/LateralControl-v0", track="circuit")
    contestants["driverview, no beams"] = (bare, steering, STEPS["driverview"])
    car = gym.make("CarRacing-v3")
    contestants["CarRacing-v3"] = (car, constant(0.0, 0.1, 0.0), STEPS["CarRacing-v3"])
    racetrack = gym.make("racetrack-v0")
    contestants["racetrack-v0"] = (racetrack, constant(0.0), STEPS["racetrack-v0"])
    figures: dict[str, list[float]] = {name: [] for name in contestants}
    for turn in range(TURNS + 1):
        for name, (env, policy, steps) in contestants.items():
            figure = steps_per_second(env, policy, steps if turn else steps // 10, seed=turn)
            if turn:  # turn 0 is the warm-up
                figures[name].append(figure)
        print(f"turn {turn} of {TURNS}", file=sys.stderr)
    for env, _, _ in contestants.values():
        env.close()
    return {name: statistics.median(values) for name, values in figures.items()}


def vector_steps_per_second(mode: str) -> float:
    """Return the steps per second of wall time of two environments in one vector environment,
    summed over both. `mode` is Gymnasium's vectorization mode: "sync" or "async"."""
    name = "driverview/LateralControl-v0"
    vector: Any = gym.make_vec(name, 2, mode, track="circuit", sensors=("range",))
    _, info = vector.reset(seed=0)
    for step in range(VECTOR_STEPS + 200):
        if step == 200:
            started = time.perf_counter()
        *_, info = vector.step(steering(info))
    seconds = time.perf_counter() - started
    vector.close()
    return 2 * VECTOR_STEPS / seconds


def main(json: Path | None = None) -> None:
    warnings.simplefilter("ignore")  # the peers print warnings
    cores = os.sched_getaffinity(0)
    # The vectors are timed before this process is pinned to one core, because their worker
    # processes inherit its cores.
    vectors = {mode: round(vector_steps_per_second(mode)) for mode in ("sync", "async")}
    os.sched_setaffinity(0, {min(cores)})
    error = beams_error(CHECKED_STEPS)
    medians = compare()
    ours = medians["driverview, 0 cars"]
    measured = {
        "steps_per_second": round(ours),
        "times_car_racing": round(ours / medians["CarRacing-v3"], 1),
        "times_racetrack": round(ours / medians["racetrack-v0"], 1),
    }
    reached = error <= BEAMS_WITHIN_M and all(
        measured[name] >= least for name, least in CLAIMS.items()
    )
    result = {
        "median_steps_per_second": {name: round(value) for name, value in medians.items()},
        "vector_of_two_steps_per_second": vectors,
        "beams_largest_error_m": round(error, 6),
        "beams_checked_steps": CHECKED_STEPS,
        **measured,
        "claims": CLAIMS,
        "reached": reached,
    }
    conclude(result, json, reached)


if __name__ == "__main__":
    run_command(main)
