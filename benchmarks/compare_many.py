"""Processor time of the public benchmark of controllers.

For each controller the public benchmark has 805 drives: on 10 tracks of the project and 13 tracks
of TORCS, without a disturbance and with each of six disturbances, each with five seeds.

Run: `python benchmarks/compare_many.py [--controllers lqr,mpc] [--share 1] [--json FILE]`. It takes
some minutes per controller on two cores, and needs TORCS's tracks (`TORCS_TRACKS`). Each controller
makes all drives at the same time, as in `controllers compare --disturb --seeds 5`. `--share` is the
share of the steps of each drive that is driven; the times are extrapolated to all steps. One drive
is also made and timed alone, and must give the same result. Claim: at most 6 minutes of processor
time per controller, which is 3 minutes on two cores.
"""

import os
import sys
import time
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")
sys.path.insert(0, str(Path(__file__).parents[1]))

from benchmarks.claims.outcome import conclude, not_measured, run_command
from controllers.drive.closed_loop import DriveResult
from controllers.drive.config import DriveConfig
from controllers.drive.disturbance import DISTURBANCES
from controllers.drive.many import Task, drive_many
from controllers.drive.run import GRID_SHARE, drive, steps_for
from simulator.track.catalogue import list_tracks
from trackfeatures.errors import UserError

SEEDS = 5
LIMIT_S = 360.0


def tasks_of(controller: str, share: float) -> tuple[list[Task], int]:
    """Return the drives of the benchmark, each with a `share` of its steps, and the number of steps
    of all drives without this reduction."""
    tasks, whole = [], 0
    for track in list_tracks():
        steps = steps_for(None, track.name, track.length_m)
        for disturbance in DISTURBANCES.values():
            for seed in range(SEEDS):
                config = DriveConfig(
                    controller=controller,
                    track=track.name,
                    steps=max(round(share * steps), 1),
                    start_d=-GRID_SHARE * track.width,
                    seed=seed,
                )
                tasks.append((config, disturbance))
                whole += steps
    return tasks, whole


def measure(controller: str, share: float) -> dict[str, float | bool]:
    """Make all drives of a controller at the same time, then one drive alone. Return the processor
    times, and whether both gave the same result for this drive.

    The times are in s (for the driven steps, and extrapolated to the whole benchmark) and in us per
    step.
    """
    tasks, whole = tasks_of(controller, share)
    for _ in drive_many(tasks[:1]):  # compiles the code before the time is measured
        pass
    found: dict[int, DriveResult | UserError] = {}
    started = time.process_time()
    for outcomes in drive_many(tasks):
        found |= {one.number: one.result for one in outcomes}
    spent = time.process_time() - started
    steps = sum(config.steps or 0 for config, _ in tasks)
    started = time.process_time()
    alone = drive(tasks[0][0], disturbance=tasks[0][1])
    single = time.process_time() - started
    return {
        "drives": len(tasks),
        "steps_driven": steps,
        "steps_of_the_benchmark": whole,
        "processor_s": round(spent, 1),
        "processor_s_extrapolated": round(spent / steps * whole, 1),
        "us_a_step": round(1e6 * spent / steps, 1),
        "us_a_step_alone": round(1e6 * single / alone.steps, 1),
        "equal": found[0] == alone,
    }


def main(
    controllers: str = "lqr,mpc,lqr-kalman,rl", share: float = 1.0, json: Path | None = None
) -> None:
    if not any(track.source == "torcs" for track in list_tracks()):
        not_measured("TORCS's tracks are missing; set TORCS_TRACKS")
    figures = {name: measure(name, share) for name in controllers.split(",")}
    reached = all(
        one["equal"] and one["processor_s_extrapolated"] <= LIMIT_S for one in figures.values()
    )
    conclude({"limit_s": LIMIT_S, **figures}, json, reached)


if __name__ == "__main__":
    run_command(main)
