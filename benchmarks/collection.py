"""Collection against the bare render loop of the same scenes, all cores, in one run.

Run: `python benchmarks/collection.py [--rounds 6] [--frames 500]`. Claim: at least 120 frames a
second at 280 x 210 on two cores, physics, rendering, labels, JPEG, MCAP and checks included.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

CLAIM_FRAMES_PER_SECOND = 120.0
FRAMES_OF_WARM_UP = 20


def collect(out: Path, rounds: int, frames: int, seed: int) -> dict[str, float]:
    """`datagen collect --json` on the project's own tracks; what it says."""
    command = [sys.executable, "-m", "datagen", "collect", "--json", "--out", str(out)]
    command += ["--rounds", str(rounds), "--frames", str(frames), "--seed", str(seed)]
    done = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True)
    result: dict[str, float] = json.loads(done.stdout)
    return result


def render_round(path: Path) -> tuple[int, float]:
    """Render every frame of a recorded round again, nothing else; frames and seconds."""
    # Mesa and numpy are to use one thread a process, as the collector's workers do.
    os.environ.update(LP_NUM_THREADS="1", OMP_NUM_THREADS="1")
    import numpy as np
    from mcap.reader import make_reader
    from mcap_protobuf.decoder import DecoderFactory

    from simulator.camera import Camera, Light
    from simulator.track.catalogue import find_track
    from simulator.track.road import Road

    with path.open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        about = next(m for m in reader.iter_metadata() if m.name == "driverview.round").metadata
        poses = [
            (m.x, m.y, m.z, m.roll, m.pitch, m.yaw)
            for _, _, _, m in reader.iter_decoded_messages(topics=["/ego/state"])
        ]
    seed = int(about["seed"])
    road = Road(find_track(json.loads(about["track"])), int(about["lanes"]))
    light = Light.named(json.loads(about["light"]), np.random.default_rng([seed, 2]))
    with Camera(road, seed=seed, light=light) as camera:
        camera.render(np.array(poses[0]), np.zeros((0, 6)))
        started = time.perf_counter()
        for pose in poses:
            camera.render(np.array(pose), np.zeros((0, 6)))
        return len(poses), time.perf_counter() - started


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", type=int, default=6)
    parser.add_argument("--frames", type=int, default=500)
    arguments = parser.parse_args()
    cores = os.cpu_count() or 1
    with tempfile.TemporaryDirectory() as folder:
        collect(Path(folder) / "warm-up", cores, FRAMES_OF_WARM_UP, seed=1)
        data = Path(folder) / "data"
        collected = collect(data, arguments.rounds, arguments.frames, seed=2)
        rounds = sorted((data / "rounds").glob("*.mcap"))
        with ProcessPoolExecutor(cores, mp_context=get_context("spawn")) as pool:
            rendered = list(pool.map(render_round, rounds))
    bare = cores * sum(n for n, _ in rendered) / sum(seconds for _, seconds in rendered)
    speed = collected["frames_per_second"]
    result = {
        "cores": cores,
        "collect_frames_per_second": round(speed, 1),
        "bare_render_frames_per_second": round(bare, 1),
        "ratio": round(speed / bare, 3),
        "claim_frames_per_second": CLAIM_FRAMES_PER_SECOND,
        "reached": speed >= CLAIM_FRAMES_PER_SECOND,
    }
    print(json.dumps(result))


if __name__ == "__main__":
    main()
