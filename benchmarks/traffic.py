"""Checks the traffic of twelve cars for ten minutes, with one, two and three lanes on every track.

Run: `python benchmarks/traffic.py [--minutes 10] [--tracks town,highway] [--json FILE]`. Claim: two
cars never overlap, both with a driving ego car and with an ego car parked in the rightmost lane.
Cars change lanes on roads with two and three lanes. The exit code is 1 if the claim does not hold.
"""

import sys
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict
from itertools import product
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1]))  # to import from tests

from benchmarks.claims.outcome import conclude, run_command
from simulator.track.catalogue import find_track, track_files
from simulator.track.road import Road
from tests.simulator.traffic_audit import TrafficViolation, audit_traffic


def one(case: tuple[str, int, bool], seconds: float) -> dict[str, Any]:
    """Audit the traffic of one case for `seconds` of simulated time. A case is (track, number of
    lanes, whether the ego car is parked).

    Returns the case with its statistics, or with the violation that was found.
    """
    name, lanes, parked = case
    about = {"track": name, "lanes": lanes, "ego_car": "parked" if parked else "drives"}
    try:
        return about | asdict(audit_traffic(Road(find_track(name), lanes), seconds, parked=parked))
    except TrafficViolation as wrong:
        return about | {"violation": str(wrong)}


def main(minutes: float = 10.0, tracks: str = "", json: Path | None = None) -> None:
    names = tracks.split(",") if tracks else list(track_files())
    cases = list(product(names, (1, 2, 3), (False, True)))
    with ProcessPoolExecutor() as pool:
        results = list(pool.map(one, cases, [60.0 * minutes] * len(cases)))
    changes = {
        lanes: sum(r.get("lane_changes", 0) for r in results if r["lanes"] == lanes)
        for lanes in (1, 2, 3)
    }
    wrong = [result for result in results if "violation" in result]
    print(f"{len(results)} roads, {len(wrong)} in violation; lane changes by lanes: {changes}")
    reached = not wrong and changes[1] == 0 and changes[2] > 0 and changes[3] > 0
    conclude(results, json, reached)


if __name__ == "__main__":
    run_command(main)
