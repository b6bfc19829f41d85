"""The simulated car against the real TORCS: same control law, same tracks, the flying lap.

Run: `TORCS_TRACKS=FOLDER python benchmarks/torcs_fit.py [--json FILE]`; FOLDER holds `tracks/` and
the reference laps `drives/NAME-lqr.csv`. Limits: steps within 1 %, score a step within 0.004, mean
|d| within 0.02 m, max |d| within 0.15 m. Exit code 1 when one is missed, 3 without reference laps.
"""

import argparse
import json
import os
import sys
from dataclasses import asdict
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))

from benchmarks.material.outcome import exit_code, not_measured
from benchmarks.material.torcs_laps import LIMITS, TRACKS, Fit, compare


def line(fit: Fit, sampling: str) -> str:
    cells = [
        f"{name} {getattr(fit.here, name):.4g} / {getattr(fit.torcs, name):.4g}"
        f" ({fit.difference[name]:+.4f}{'' if fit.within[name] else ' MISSED'})"
        for name in LIMITS
    ]
    return f"{fit.track:10} {sampling:12} here / TORCS: " + ", ".join(cells)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--json", type=Path, help="write the figures to this file")
    arguments = parser.parse_args()
    folder = Path(os.environ.get("TORCS_TRACKS") or "nowhere") / "drives"
    if not folder.is_dir():
        return not_measured("set TORCS_TRACKS to a folder with drives/, laps of the real TORCS")
    results = []
    for name in TRACKS:
        for sampling, as_recorded in (("as recorded", True), ("every 50 ms", False)):
            fit = compare(name, folder, as_recorded=as_recorded)
            print(line(fit, sampling))
            record = {"sampling": sampling, "difference": fit.difference, "within": fit.within}
            results.append(asdict(fit) | record)
    if arguments.json:
        arguments.json.write_text(json.dumps(results, indent=2) + "\n")
    return exit_code(all(all(result["within"].values()) for result in results))


if __name__ == "__main__":
    sys.exit(main())
