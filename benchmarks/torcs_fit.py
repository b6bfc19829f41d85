"""Compares flying laps of the simulated car with flying laps in the real TORCS, with the same
control law and tracks.

Run: `TORCS_TRACKS=FOLDER python benchmarks/torcs_fit.py [--json FILE]`. FOLDER contains `tracks/`
and the recorded laps `drives/NAME-lqr.csv`. Limits of the differences: number of steps 1 %, score
per step 0.004, mean |d| 0.02 m, largest |d| 0.15 m (d: offset from the centre line). The exit code
is 1 if a difference is above its limit, and 3 if there are no recorded laps.
"""

import os
import sys
from dataclasses import asdict
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))

from benchmarks.claims.outcome import conclude, not_measured, run_command
from benchmarks.recordings.torcs_laps import TRACKS, compare


def main(json: Path | None = None) -> None:
    folder = Path(os.environ.get("TORCS_TRACKS") or "nowhere") / "drives"
    if not folder.is_dir():
        not_measured("set TORCS_TRACKS to a folder with drives/, laps of the real TORCS")
    results = []
    for name in TRACKS:
        for sampling, as_recorded in (("as recorded", True), ("every 50 ms", False)):
            fit = compare(name, folder, as_recorded=as_recorded)
            record = {"sampling": sampling, "difference": fit.difference, "within": fit.within}
            results.append(asdict(fit) | record)
    conclude(results, json, all(all(result["within"].values()) for result in results))


if __name__ == "__main__":
    run_command(main)
