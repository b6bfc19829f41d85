"""Time of `datagen verify --level full`, beside reading and hashing the same files, warm.

Run: `python benchmarks/verification.py [--data DIR] [--json FILE]`. Claim: at most 15 s for 120,000
frames on two cores. Without `--data`, 60 rounds of 2,000 frames are made from a few collected ones.
Exit code: 0 reached, 1 missed, 3 not measured (the dataset has fewer frames than the claim).
"""

import argparse
import hashlib
import json
import os
import statistics
import sys
import tempfile
import time
import zlib
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

LIMIT_S = 15.0
LIMIT_FRAMES = 120_000
REPEATS = 3


def hash_files(folder: Path) -> None:
    """Read every byte and compute SHA-256 and CRC-32: the minimum of any such check."""

    def one(file: Path) -> str:
        data = file.read_bytes()
        zlib.crc32(data)
        return hashlib.sha256(data).hexdigest()

    with ThreadPoolExecutor(len(os.sched_getaffinity(0))) as pool:
        list(pool.map(one, sorted((folder / "rounds").glob("*.mcap"))))


def measure(folder: Path) -> dict[str, object]:
    from datagen.recording.integrity.verify import verify

    verify_s: dict[str, list[float]] = {"quick": [], "full": []}
    hash_s: list[float] = []
    cpu_s: list[float] = []
    frames = 0
    for _ in range(REPEATS):
        for level, seconds in verify_s.items():
            started, cpu = time.perf_counter(), time.process_time()
            report = verify(folder, level)
            seconds.append(time.perf_counter() - started)
            if not report.ok:
                sys.exit(f"the data set has problems: {report.problems[0]}")
            frames = report.frames
        cpu_s.append(time.process_time() - cpu)
        started = time.perf_counter()
        hash_files(folder)
        hash_s.append(time.perf_counter() - started)
    size = sum(file.stat().st_size for file in (folder / "rounds").glob("*.mcap"))
    full, bare = statistics.median(verify_s["full"]), statistics.median(hash_s)
    return {
        "frames": frames,
        "gigabytes": round(size / 1e9, 3),
        "quick_s": round(statistics.median(verify_s["quick"]), 3),
        "full_s": round(full, 2),
        "full_best_s": round(min(verify_s["full"]), 2),
        "full_cpu_s": round(statistics.median(cpu_s), 2),
        "hash_alone_s": round(bare, 2),
        "full_to_hash_alone": round(full / bare, 2),
        "gigabytes_per_second": round(size / 1e9 / full, 2),
        "cores": len(os.sched_getaffinity(0)),
        "limit_s": LIMIT_S,
        "reached": full <= LIMIT_S if frames >= LIMIT_FRAMES else None,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, help="a dataset; by default one is made")
    parser.add_argument("--rounds", type=int, default=60)
    parser.add_argument("--frames", type=int, default=2000)
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    sys.path.insert(0, str(Path(__file__).parents[1]))
    from benchmarks.material.outcome import exit_code, not_measured
    from benchmarks.material.rounds import collect, enlarge

    with tempfile.TemporaryDirectory() as home:
        data = arguments.data
        if data is None:
            few = collect(Path(home) / "few", rounds=4, frames=150)
            data = enlarge(few, Path(home) / "data", arguments.rounds, arguments.frames)
        result = measure(data)
    print(json.dumps(result, indent=1))
    if arguments.json:
        arguments.json.write_text(json.dumps(result, indent=1) + "\n")
    if result["reached"] is None:
        sys.exit(not_measured(f"the claim is of {LIMIT_FRAMES} frames, found {result['frames']}"))
    sys.exit(exit_code(bool(result["reached"])))


if __name__ == "__main__":
    main()
