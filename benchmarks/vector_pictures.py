"""Compares the processor time of a step with a picture in a vector environment and in a single
environment.

Run: `python benchmarks/vector_pictures.py [--json FILE]`; it takes about a minute on an idle core.
In the vector environment two workers draw the pictures (280 x 210 px) of eight cars. Claim: a step
of one car with its picture takes at most 1.15 times the processor time of a step of a single
environment. The processor time of all processes is counted.

The two environments take turns on the same stretch of road. The single environment drives this
stretch eight times per turn, so that both make the same number of car steps. Each process draws in
one thread. A figure is the median over the turns.
"""

import os
import statistics
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

os.environ.update(OMP_NUM_THREADS="1", LP_NUM_THREADS="0")
sys.path.insert(0, str(Path(__file__).parents[1]))

import gymnasium as gym
import numpy as np

import simulator.env  # noqa: F401  (registers the names)
from benchmarks.claims.outcome import conclude, run_command

NAME = "driverview/DriverView-v0"
CARS, WORKERS = 8, 2
MOST = 1.15
TURNS, STEPS = 5, 30
START = {"speed": 15.0}


def processor_s(processes: list[int]) -> float:
    """Return the processor time in s that the processes with the ids `processes` have used so far,
    summed over them."""
    times = 0
    for process in processes:
        fields = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
        times += int(fields[11]) + int(fields[12])
    return times / os.sysconf("SC_CLK_TCK")


def drive(env: Any, action: Any, times: int) -> Callable[[], None]:
    """Return a function that drives the same STEPS steps `times` times, with a constant action."""

    def run() -> None:
        for _ in range(times):
            env.reset(seed=0)
            for _ in range(STEPS):
                env.step(action)

    return run


def main(json: Path | None = None) -> None:
    vector = gym.make_vec(
        NAME,
        CARS,
        vectorization_mode="vector_entry_point",
        workers=WORKERS,
        copy=False,
        start=START,
    )
    single = gym.make(NAME, disable_env_checker=True, start=START)
    contestants = {
        "vector": drive(vector, np.zeros((CARS, 1), np.float32), 1),
        "single environment": drive(single, np.zeros(1, np.float32), CARS),
    }
    vector.reset(seed=0)  # starts the workers
    workers = [each.process.pid for each in vector._observer._pictures._pool._workers]  # type: ignore[attr-defined]
    processes = [os.getpid(), *workers]
    figures: dict[str, list[float]] = {name: [] for name in contestants}
    for turn in range(TURNS + 1):
        for name, run in contestants.items():
            begin = processor_s(processes)
            run()
            if turn:  # turn 0 is the warm-up
                taken_s = processor_s(processes) - begin
                figures[name].append(1e3 * taken_s / (CARS * (STEPS + 1)))
    vector.close()
    medians = {name: statistics.median(values) for name, values in figures.items()}
    ratio = medians["vector"] / medians["single environment"]
    result = {
        "processor_ms_a_step_with_a_picture": {k: round(v, 2) for k, v in medians.items()},
        "ratio": round(ratio, 3),
        "claims": {"ratio": MOST},
        "reached": ratio <= MOST,
    }
    conclude(result, json, ratio <= MOST)


if __name__ == "__main__":
    run_command(main)
