"""The simulated car against the real TORCS: the same law, the same tracks, the flying lap.

Run: `TORCS_TRACKS=FOLDER python benchmarks/torcs_fit.py`, FOLDER holding `tracks/` and the
reference laps `drives/NAME-lqr.csv`. Limits: steps within 1 %, score a step within 0.004, mean |d|
within 0.02 m, max |d| within 0.15 m.
"""

import json
import os
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from controllers.trip import DriveConfig, drive
from simulator.track.catalogue import find_track

TRACKS = ("forza", "g-track-3")
FLYING_LAP = 2
LIMITS = {"steps": 0.01, "score_per_step": 0.004, "mean_abs_d_m": 0.02, "max_abs_d_m": 0.15}


@dataclass(frozen=True)
class Lap:
    """The figures of one flying lap."""

    steps: int
    score_per_step: float
    mean_abs_d_m: float
    max_abs_d_m: float
    least_speed_kmh: float
    most_speed_kmh: float


def flying_lap(path: Path, half_width: float) -> Lap:
    """Read it from a drive's CSV, ours or the reference's."""
    rows = np.genfromtxt(path, delimiter=",", names=True, skip_header=_comments(path))
    lap = rows[rows["lap"] == FLYING_LAP]
    offset, heading = np.abs(lap["d"]), lap["th"]
    score = np.cos(heading) - np.abs(np.sin(heading)) - offset / half_width
    speed = lap["v"] * 3.6
    return Lap(
        len(lap),
        float(score.mean()),
        float(offset.mean()),
        float(offset.max()),
        float(speed.min()),
        float(speed.max()),
    )


def _comments(path: Path) -> int:
    with path.open() as lines:
        return 1 if next(lines).startswith("#") else 0


def compare(name: str, drives: Path) -> dict[str, object]:
    """Drive two laps and a bit with the reference's law; both flying laps and what differs."""
    half_width = find_track(name).width / 2
    reference = flying_lap(drives / f"{name}-lqr.csv", half_width)
    with tempfile.TemporaryDirectory() as folder:
        log = Path(folder) / "drive.csv"
        drive(
            DriveConfig(controller="torcs", track=name, steps=2 * reference.steps + 1500, log=log)
        )
        ours = flying_lap(log, half_width)
    differences = {figure: getattr(ours, figure) - getattr(reference, figure) for figure in LIMITS}
    differences["steps"] /= reference.steps
    return {
        "track": name,
        "ours": vars(ours),
        "torcs": vars(reference),
        "difference": differences,
        "within": {figure: abs(differences[figure]) <= limit for figure, limit in LIMITS.items()},
    }


def main() -> None:
    folder = os.environ.get("TORCS_TRACKS")
    if not folder or not (Path(folder) / "drives").is_dir():
        print("TORCS_TRACKS names no folder with drives/; nothing to compare with", file=sys.stderr)
        return
    for name in TRACKS:
        print(json.dumps(compare(name, Path(folder) / "drives")))


if __name__ == "__main__":
    main()
