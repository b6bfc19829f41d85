"""Time of one controller step, and of a whole control step with images.

Run: `python benchmarks/controller_time.py [--track town] [--steps 3000] [--model RUN]
[--json FILE]`. Each controller drives the track, and only its `update` is timed. Then `lqr` drives
on the answers of the service, which runs in another process. In this drive the whole control step
is timed: rendering, HTTP request and controller. Limits: for MPC a median of 0.3 ms and a p99 of 1
ms, for LQR and RL a p99 of 0.1 ms, for a control step with images a p99 of 25 ms. The exit code is
1 if a time is above its limit.
"""

import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))

from benchmarks.claims.outcome import conclude, run_command
from benchmarks.service_load.servers import OURS, running
from controllers.drive.closed_loop import run_lap
from controllers.interface import Controller, LoopConfig, Observation
from controllers.perception.sources import open_perception, truth
from controllers.registry import make_controller
from mtlnet.inference.shipped_models import SHIPPED
from simulator.track.catalogue import find_track
from simulator.track.road import Road
from simulator.world.world import World

MEDIAN_MS = {"mpc": 0.3, "mpc-preview": 0.3}
P99_MS = {
    "lqr": 0.1,
    "lqr-preview": 0.1,
    "lqr-paper": 0.1,
    "rl": 0.1,
    "rl-residual": 0.1,
    "mpc": 1.0,
    "mpc-preview": 1.0,
}
IMAGES, IMAGES_P99_MS = "lqr on images", 25.0
WARM_UP = 20  # control steps with images that are driven first and not timed


class Timed:
    """Calls a function of one argument and stores the wall time of each call in `times_ms`."""

    def __init__(self, function: Callable[[Any], Any]) -> None:
        self._function = function
        self.times_ms: list[float] = []

    def __call__(self, argument: Any) -> Any:
        started = time.perf_counter()
        result = self._function(argument)
        self.times_ms.append(1000.0 * (time.perf_counter() - started))
        return result


class TimedController:
    """Wraps a controller and times its `update`; the times are in `timed.times_ms`."""

    def __init__(self, controller: Controller) -> None:
        self.timed = Timed(controller.update)

    def update(self, observation: Observation) -> float:
        return float(self.timed(observation))


def on_images(world: World, model: str, steps: int) -> list[float]:
    """Drive `steps` steps with `lqr` on the service's answers; return the time of each step in ms.

    A step contains rendering, the request to the service and the controller.
    """
    with running(OURS, Path(sys.executable), Path(model), workers=1) as port:
        address = f"http://127.0.0.1:{port}"
        settings: dict[str, Any] = {"model": model, "lane_centre": 0.0, "light": "clear", "seed": 0}
        with open_perception(address, world, **settings) as source:
            world.reset(seed=0, to_middle=1.0)
            perceive = Timed(source)
            controller = TimedController(make_controller("lqr", LoopConfig(0.05)))
            run_lap(world, controller, perceive, steps + WARM_UP)
    found = np.add(perceive.times_ms, controller.timed.times_ms)
    return [float(value) for value in found[WARM_UP:]]


def main(
    track: str = "town", steps: int = 3000, model: str = str(SHIPPED), json: Path | None = None
) -> None:
    times = {}
    with World(Road(find_track(track))) as world:
        for name in P99_MS:
            world.reset(seed=0, to_middle=1.0)
            controller = TimedController(make_controller(name, LoopConfig(0.05)))
            run_lap(world, controller, truth(0.0), steps)
            times[name] = controller.timed.times_ms
        times[IMAGES] = on_images(world, model, steps)
    results = {}
    for name, limit in {**P99_MS, IMAGES: IMAGES_P99_MS}.items():
        median, p99 = (float(value) for value in np.percentile(times[name], (50, 99)))
        reached = p99 <= limit and median <= MEDIAN_MS.get(name, limit)
        figures = {"median_ms": median, "p99_ms": p99, "limit_ms": limit}
        results[name] = {**figures, "reached": reached}
    conclude(results, json, all(result["reached"] for result in results.values()))


if __name__ == "__main__":
    run_command(main)
