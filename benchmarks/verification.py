"""Measures the time of `datagen verify --level full`, and of only reading and hashing the same
files.

Run: `python benchmarks/verification.py [--data DIR] [--json FILE]`. Claim: at most 15 s for 120,000
frames on two cores, with the files in the page cache. Without `--data`, 60 rounds of 2,000 frames
are made from a few collected rounds. Exit code: 0 if the claim is reached, 1 if it is missed, 3 if
it is not measured (the dataset has fewer frames than the claim).
"""

import hashlib
import os
import statistics
import sys
import tempfile
import time
import zlib
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1]))

from benchmarks.claims.outcome import conclude, run_command
from benchmarks.recordings.enlarged import enlarged_few
from datagen.recording.integrity.verify import verify

LIMIT_S = 15.0
LIMIT_FRAMES = 120_000
REPEATS = 3


def hash_files(folder: Path) -> None:
    """Read all rounds in `folder` and compute their SHA-256 and CRC-32. A check that compares these
    two sums cannot take less time."""

    def one(file: Path) -> str:
        data = file.read_bytes()
        zlib.crc32(data)
        return hashlib.sha256(data).hexdigest()

    with ThreadPoolExecutor(len(os.sched_getaffinity(0))) as pool:
        list(pool.map(one, sorted((folder / "rounds").glob("*.mcap"))))


def measure(folder: Path) -> dict[str, Any]:
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
        "limit_is_of_frames": LIMIT_FRAMES,
    }


def main(
    data: Path | None = None, rounds: int = 60, frames: int = 2000, json: Path | None = None
) -> None:
    with tempfile.TemporaryDirectory() as home:
        result = measure(data or enlarged_few(Path(home), rounds, frames))
    measured = result["frames"] >= LIMIT_FRAMES
    conclude(result, json, result["full_s"] <= LIMIT_S if measured else None)


if __name__ == "__main__":
    run_command(main)
