"""Growth of a process's memory during eight simulated hours of driving with resets.

Run: `python benchmarks/soak.py [--hours 8] [--json FILE]`; it takes about five minutes on one core.
Claim: after the warm-up, which contains every kind of drive, the resident memory grows by less than
1 %. Environments are created, driven, reset and closed repeatedly, on all tracks of the project,
with one to three lanes and 0 to 12 cars in the traffic. After every second drive follows a short
drive with pictures and a new camera.
"""

import os
import statistics
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

os.environ.setdefault("LP_NUM_THREADS", "1")

sys.path.insert(0, str(Path(__file__).parents[1]))

import gymnasium as gym
import numpy as np

import simulator.env  # noqa: F401  (registers the names)
from benchmarks.claims.outcome import conclude, run_command
from simulator.camera import KINDS
from simulator.track.catalogue import OWN_TRACKS

CLAIM_GROWTH = 0.01
FREQUENCY_HZ = 20
DRIVE_STEPS = 6000
RESET_EVERY = 1200
PICTURE_STEPS = 40
WARM_UP_DRIVES = 60
"""Each of the ten tracks is driven with 1, 2 and 3 lanes, twice. The heap grows during these
drives."""
COMPARED = 10
"""The medians of the first and of the last ten samples are compared, because a single sample
depends on the environment of the last drive, which is still in memory."""


@dataclass(frozen=True)
class Sample:
    """Resident memory and open file descriptors of this process after `hours` of driving."""

    hours: float
    resident_mib: float
    descriptors: int


def resident_mib() -> float:
    """Return the resident memory of this process in MiB."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 2**20


def steering(info: dict[str, Any], wander: float) -> np.ndarray[Any, Any]:
    """Return the action (1,) that steers towards an offset of `wander` m left of the centre line.
    `info` is the additional output of the environment."""
    wheel = 2.0 * info["angle"] - 0.2 * (info["to_middle"] - wander)
    return np.array([min(max(wheel, -1.0), 1.0)], np.float32)


def drive(number: int, tracks: list[str], steps: int) -> int:
    """Make the environment of drive `number`, drive it for `steps` steps and close it; return the
    number of resets.

    After every second drive follows a short drive with pictures.
    """
    # Ten tracks and three lane counts: thirty drives in a row all differ.
    options: dict[str, Any] = {
        "track": tracks[number % len(tracks)],
        "lanes": 1 + number // len(tracks) % 3,
        "traffic": (0, 6, 12)[number % 3],
        "frequency_hz": FREQUENCY_HZ,
    }
    name, sensors = "driverview/LateralControl-v0", ("range", "range_traffic", "v_x")
    env = gym.make(name, **options, sensors=sensors, noise=True, sensor_noise={"v_x": 0.1})
    resets = steps_with_resets(env, number, steps, RESET_EVERY)
    env.close()
    if number % 2 == 0:
        light = KINDS[number // 2 % len(KINDS)]
        views = ("front", "rear", "front:depth")
        seen = gym.make(
            "driverview/DriverView-v0", **options, light=light, light_seed=number, views=views
        )
        steps_with_resets(seen, number, PICTURE_STEPS, RESET_EVERY)
        if number % 4 == 0:
            seen.close()  # half of the environments stay open, because users forget to close them
    return resets


def steps_with_resets(env: gym.Env[Any, Any], seed: int, steps: int, reset_every: int) -> int:
    """Drive `steps` steps with resets every `reset_every` steps; return the number of resets."""
    resets, since = 1, 0
    _, info = env.reset(seed=seed)
    for step in range(steps):
        _, _, ended, _, info = env.step(steering(info, float(np.sin(step / 40))))
        since += 1
        if ended or since == reset_every:
            _, info = env.reset()
            resets, since = resets + 1, 0
    return resets


def soak(hours: float) -> tuple[list[Sample], int]:
    """Warm up and drive for `hours`; return a sample after each drive, and the number of resets."""
    tracks = sorted(path.stem for path in OWN_TRACKS.glob("*.toml"))
    total = round(hours * 3600 * FREQUENCY_HZ)
    for number in range(WARM_UP_DRIVES):
        drive(number, tracks, RESET_EVERY)
        print(f"warm-up {number + 1}/{WARM_UP_DRIVES}: {resident_mib():.1f} MiB", file=sys.stderr)
    samples, done, resets, number = [sample(0.0)], 0, 0, 0
    while done < total:
        steps = min(DRIVE_STEPS, total - done)
        resets += drive(number, tracks, steps)
        done, number = done + steps, number + 1
        samples.append(sample(done / 3600 / FREQUENCY_HZ))
        last = samples[-1]
        print(f"{last.hours:.2f} h: {last.resident_mib:.1f} MiB", file=sys.stderr)
    return samples, resets


def sample(hours: float) -> Sample:
    return Sample(hours, resident_mib(), len(list(Path("/proc/self/fd").iterdir())))


def main(hours: float = 8.0, json: Path | None = None) -> None:
    started = time.perf_counter()
    samples, resets = soak(hours)
    last = samples[-1]
    before, after = (
        statistics.median(each.resident_mib for each in part)
        for part in (samples[:COMPARED], samples[-COMPARED:])
    )
    growth = after / before - 1.0
    reached = growth < CLAIM_GROWTH and last.descriptors <= samples[0].descriptors
    result = {
        "simulated_hours": last.hours,
        "control_steps": round(last.hours * 3600 * FREQUENCY_HZ),
        "environments": len(samples) - 1,
        "resets": resets,
        "seconds": round(time.perf_counter() - started, 1),
        "resident_mib_after_warm_up": round(before, 1),
        "resident_mib_highest": round(max(each.resident_mib for each in samples), 1),
        "resident_mib_at_the_end": round(after, 1),
        "descriptors": [samples[0].descriptors, last.descriptors],
        "growth": round(growth, 5),
        "claim_growth_below": CLAIM_GROWTH,
        "reached": reached,
    }
    conclude(result, json, reached)


if __name__ == "__main__":
    run_command(main)
