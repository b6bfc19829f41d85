"""Collection against the bare render loop of the same scenes, all cores, in one run.

Run: `python benchmarks/collection.py [--rounds 60] [--frames 2000] [--out FOLDER] [--json FILE]`.
The dataset stays in `FOLDER/data` where a folder is given. Claim (on two cores with Mesa, 280 x
210): at least 250 frames a second, physics, rendering, labels, JPEG, MCAP and checks included, and
at least 0.75 of what drawing alone reaches. The bare loop draws the same frames, traffic and all,
and does nothing else; its scenes are built before the clock starts. Ratios are of wall time, which
decides, and of processor time, which depends less on other jobs. Sixty rounds are the default: with
fewer, start-up and the end, when a core idles, weigh more than in real use.
"""

import argparse
import contextlib
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any

CLAIM_FRAMES_PER_SECOND = 250.0
CLAIM_RATIO = 0.75
FRAMES_OF_WARM_UP = 20


def collect(out: Path, rounds: int, frames: int, seed: int) -> dict[str, Any]:
    """Run `datagen collect --json`: its result, and the processor time of all its processes."""
    command = [sys.executable, "-m", "datagen", "collect", "--json", "--out", str(out)]
    command += ["--rounds", str(rounds), "--frames", str(frames), "--seed", str(seed)]
    command += ["--stretch", "1"]  # a training set: more sceneries to build than a film has
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    done = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    cpu_s = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return {**json.loads(done.stdout), "cpu_s": cpu_s}


def draw_round(entry: dict[str, Any]) -> tuple[int, float, float]:
    """Simulate a round of the plan and render it: number of frames, wall and processor seconds."""
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


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", type=int, default=60)
    parser.add_argument("--frames", type=int, default=2000)
    parser.add_argument("--out", type=Path)
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    cores = len(os.sched_getaffinity(0))
    with contextlib.ExitStack() as held:
        folder = arguments.out or held.enter_context(tempfile.TemporaryDirectory())
        collect(Path(folder) / "warm-up", cores, FRAMES_OF_WARM_UP, seed=1)
        data = Path(folder) / "data"
        collected = collect(data, arguments.rounds, arguments.frames, seed=2)
        plan = json.loads((data / "plan.json").read_text())
        with ProcessPoolExecutor(cores, mp_context=get_context("spawn")) as pool:
            drawn = list(pool.map(draw_round, plan["rounds"]))
    frames = sum(count for count, _, _ in drawn)
    bare = cores * frames / sum(wall for _, wall, _ in drawn)
    speed = float(collected["frames_per_second"])
    result = {
        "cores": cores,
        "frames": frames,
        "collect_frames_per_second": round(speed, 1),
        "bare_frames_per_second": round(bare, 1),
        "ratio": round(speed / bare, 3),
        "collect_cpu_ms_per_frame": round(1000.0 * collected["cpu_s"] / frames, 3),
        "bare_cpu_ms_per_frame": round(1000.0 * sum(cpu for _, _, cpu in drawn) / frames, 3),
        "cpu_ratio": round(sum(cpu for _, _, cpu in drawn) / collected["cpu_s"], 3),
        "claims": {"frames_per_second": CLAIM_FRAMES_PER_SECOND, "ratio": CLAIM_RATIO},
    }
    result["reached"] = speed >= CLAIM_FRAMES_PER_SECOND and speed / bare >= CLAIM_RATIO
    text = json.dumps(result, indent=1)
    print(text)
    if arguments.json:
        arguments.json.write_text(text + "\n")
    sys.exit(0 if result["reached"] else 1)


if __name__ == "__main__":
    main()
