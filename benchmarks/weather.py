"""Measures the processor time per frame in each kind of light, relative to the clear light of the
same scene.

Run: `python benchmarks/weather.py [--poses 40] [--json FILE]`; `--poses` is the number of poses on
each track. Claim: rain and snow take at most 1.25 times the processor time of the clear light, with
Mesa drawing in the calling thread. The lights take turns at each pose.
"""

import os
import sys
import time
from pathlib import Path

os.environ.setdefault("LP_NUM_THREADS", "0")  # before Mesa reads it: draw in this thread

sys.path.insert(0, str(Path(__file__).parents[1]))

import numpy as np

from benchmarks.claims.outcome import conclude, run_command
from simulator.camera import KINDS, Camera, Light
from simulator.camera.scene.light import WEATHERS
from simulator.camera.snapshot import standing_pose
from simulator.track.catalogue import find_track
from simulator.track.road import Road

CLAIM_RATIO = 1.25
TRACKS = ("circuit", "forest", "coast")
PASSES = 3


def measure(poses: int) -> dict[str, float]:
    """Return the processor time of a frame in ms by kind of light.

    The time is the median over the poses. The time of a pose is the shortest time of PASSES
    renderings.
    """
    best: dict[str, list[float]] = {kind: [] for kind in KINDS}
    for track in TRACKS:
        road = Road(find_track(track), 2)
        rng = np.random.default_rng(0)
        places = [standing_pose(road, s, 0.0) for s in rng.uniform(0, road.track.length_m, poses)]
        cameras = {
            kind: Camera(road, seed=3, light=Light.named(kind, np.random.default_rng(1)))
            for kind in KINDS
        }
        spent = np.zeros((len(KINDS), poses, PASSES))
        for turn in range(PASSES):
            for p, pose in enumerate(places):
                for k, kind in enumerate(KINDS):
                    start = time.process_time()
                    cameras[kind].render(pose)
                    spent[k, p, turn] = time.process_time() - start
        for k, kind in enumerate(KINDS):
            best[kind] += list(1e3 * spent[k].min(axis=1))
            cameras[kind].close()
    return {kind: round(float(np.median(values)), 3) for kind, values in best.items()}


def main(poses: int = 40, json: Path | None = None) -> None:
    frame_ms = measure(poses)
    ratio = {kind: round(value / frame_ms["clear"], 3) for kind, value in frame_ms.items()}
    reached = all(ratio[kind] <= CLAIM_RATIO for kind in WEATHERS)
    result = {"frame_ms": frame_ms, "ratio": ratio, "claim": CLAIM_RATIO, "reached": reached}
    conclude(result, json, reached)


if __name__ == "__main__":
    run_command(main)
