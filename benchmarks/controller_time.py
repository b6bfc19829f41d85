"""The time of one controller step, on the states of a drive.

Run: `python benchmarks/controller_time.py [--track town] [--steps 3000] [--json FILE]`. Each
controller drives the track and its `update` is timed alone. Limits: MPC median 0.3 ms and p99 1 ms,
LQR p99 0.1 ms. Exit code 1 when one is missed.
"""

import argparse
import json
import sys
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))

from benchmarks.material.outcome import exit_code
from controllers.closed_loop import run_lap
from controllers.interface import Controller, LoopConfig, Observation
from controllers.perception import truth
from controllers.registry import make_controller
from simulator.track.catalogue import find_track
from simulator.track.road import Road
from simulator.world.world import World

MEDIAN_MS = {"mpc": 0.3, "mpc-preview": 0.3}
P99_MS = {"lqr": 0.1, "lqr-preview": 0.1, "lqr-paper": 0.1, "mpc": 1.0, "mpc-preview": 1.0}


class Timed:
    """A controller whose steps are timed, in ms."""

    def __init__(self, controller: Controller) -> None:
        self._controller = controller
        self.times_ms: list[float] = []

    def update(self, observation: Observation) -> float:
        started = time.perf_counter()
        steer = self._controller.update(observation)
        self.times_ms.append(1000.0 * (time.perf_counter() - started))
        return steer


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--track", default="town")
    parser.add_argument("--steps", type=int, default=3000)
    parser.add_argument("--json", type=Path, help="write the figures to this file")
    arguments = parser.parse_args()
    results = {}
    with World(Road(find_track(arguments.track))) as world:
        for name, limit in P99_MS.items():
            world.reset(seed=0, to_middle=1.0)
            timed = Timed(make_controller(name, LoopConfig(0.05)))
            run_lap(world, timed, truth(0.0), arguments.steps)
            median, p99 = (float(value) for value in np.percentile(timed.times_ms, (50, 99)))
            reached = p99 <= limit and median <= MEDIAN_MS.get(name, limit)
            results[name] = {"median_ms": median, "p99_ms": p99, "reached": reached}
            missed = "" if reached else " MISSED"
            print(f"{name:12} median {median:.4f} ms, p99 {p99:.4f} ms (limit {limit}){missed}")
    if arguments.json:
        arguments.json.write_text(json.dumps(results, indent=2) + "\n")
    return exit_code(all(result["reached"] for result in results.values()))


if __name__ == "__main__":
    sys.exit(main())
