"""Speed of `datagen collect`, compared with only rendering the same frames, on all cores.

Run: `python benchmarks/collection.py [--rounds 60] [--frames 2000] [--out FOLDER] [--json FILE]`.
If FOLDER is given, the dataset stays in `FOLDER/data`. Claim (two cores, Mesa, 280 x 210 px): at
least 250 frames per second, including physics, rendering, labels, JPEG, MCAP and checks, and at
least 0.75 of the frames per second of rendering alone. Rendering alone draws the same frames with
the same traffic; its scenes are built before its time is measured. The result has the ratios of the
two wall times, which the claim concerns, and of the two processor times, which depend less on other
jobs. With fewer than the default 60 rounds the start-up and the end of a collection, when a core is
idle, would have too much weight.
"""

import contextlib
import os
import resource
import sys
import tempfile
import time
from concurrent.futures import ProcessPoolExecutor
from json import loads
from multiprocessing import get_context
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1]))

from benchmarks.claims.outcome import conclude, run_command
from benchmarks.recordings.enlarged import collect

CLAIM_FRAMES_PER_SECOND = 250.0
CLAIM_RATIO = 0.75
FRAMES_OF_WARM_UP = 20


def collect_timed(out: Path, rounds: int, frames: int, seed: int) -> dict[str, Any]:
    """Run `datagen collect`; return its JSON result with the processor time in s as `cpu_s`."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    # stretch=1: every frame has another scenery, as in a training set.
    found = collect(out, rounds=rounds, frames=frames, seed=seed, stretch=1)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    cpu_s = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return {**found, "cpu_s": cpu_s}


def draw_round(entry: dict[str, Any]) -> tuple[int, float, float]:
    """Simulate and render the round `entry` of the dataset's plan.

    Returns the number of frames, and the wall time and the processor time of the rendering in s.
    """
    # One thread per process for Mesa and numpy, as in the collector's workers.
    os.environ.update(LP_NUM_THREADS="0", OMP_NUM_THREADS="1")
    from datagen.planning.plan import RoundPlan
    from datagen.recorder.record import open_simulation, simulate

    with open_simulation(RoundPlan.from_json(entry), None) as (simulation, camera):
        drawn, wall_s, cpu_s = 0, 0.0, 0.0
        for batch in simulate(simulation, camera):
            batch[0].render(camera)
            started, cpu = time.perf_counter(), time.process_time()
            for truth in batch:
                truth.render(camera)
            wall_s += time.perf_counter() - started
            cpu_s += time.process_time() - cpu
            drawn += len(batch)
        return drawn, wall_s, cpu_s


def main(
    rounds: int = 60, frames: int = 2000, out: Path | None = None, json: Path | None = None
) -> None:
    cores = len(os.sched_getaffinity(0))
    with contextlib.ExitStack() as held:
        folder = out or Path(held.enter_context(tempfile.TemporaryDirectory()))
        collect_timed(folder / "warm-up", cores, FRAMES_OF_WARM_UP, seed=1)
        collected = collect_timed(folder / "data", rounds, frames, seed=2)
        plan = loads((folder / "data" / "plan.json").read_text())
        with ProcessPoolExecutor(cores, mp_context=get_context("spawn")) as pool:
            drawn = list(pool.map(draw_round, plan["rounds"]))
    count = sum(part for part, _, _ in drawn)
    bare = cores * count / sum(wall for _, wall, _ in drawn)
    speed = float(collected["frames_per_second"])
    result = {
        "cores": cores,
        "frames": count,
        "collect_frames_per_second": round(speed, 1),
        "bare_frames_per_second": round(bare, 1),
        "ratio": round(speed / bare, 3),
        "collect_cpu_ms_per_frame": round(1000.0 * collected["cpu_s"] / count, 3),
        "bare_cpu_ms_per_frame": round(1000.0 * sum(cpu for _, _, cpu in drawn) / count, 3),
        "cpu_ratio": round(sum(cpu for _, _, cpu in drawn) / collected["cpu_s"], 3),
        "claims": {"frames_per_second": CLAIM_FRAMES_PER_SECOND, "ratio": CLAIM_RATIO},
    }
    reached = speed >= CLAIM_FRAMES_PER_SECOND and speed / bare >= CLAIM_RATIO
    conclude({**result, "reached": reached}, json, reached)


if __name__ == "__main__":
    run_command(main)
