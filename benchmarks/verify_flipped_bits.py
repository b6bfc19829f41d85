"""Flips single bits in a dataset; `datagen verify --level full` must find each of them.

Run: `python benchmarks/verify_flipped_bits.py [--flips 1000] [--seed 0] [--data DIR] [--json
FILE]`. One bit of one file is flipped, the dataset is verified, and the bit is restored. Three of
four flips are in random bytes of the rounds. Every fourth flip is in another file: states, splits,
the manifest or a file that the manifest lists. Without `--data` a few rounds are collected. If a
dataset is given by `--data`, it is copied first.
"""

import shutil
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))

from benchmarks.claims.outcome import conclude, run_command
from benchmarks.recordings.enlarged import collect_few
from datagen.recording.integrity.verify import verify

DERIVED = ("README.md",)  # people edit this file, so no hash of it is stored


def flip(path: Path, at: int, bit: int) -> None:
    with path.open("r+b") as stream:
        stream.seek(at)
        (byte,) = stream.read(1)
        stream.seek(at)
        stream.write(bytes([byte ^ (1 << bit)]))


def flip_bits(data: Path, flips: int, seed: int) -> dict[str, object]:
    rng = np.random.default_rng(seed)
    rounds = sorted((data / "rounds").glob("*.mcap"))
    named = {p for p in data.rglob("*") if p.is_file() and "/." not in str(p)[len(str(data)) :]}
    beside = sorted(named - set(rounds) - {data / name for name in DERIVED})
    if not verify(data, "full").ok:
        sys.exit("the untouched dataset is not in order")
    tried: Counter[str] = Counter()
    missed: list[str] = []
    started = time.perf_counter()
    for number in range(flips):
        files = beside if number % 4 == 3 else rounds
        path = files[int(rng.integers(len(files)))]
        at, bit = int(rng.integers(path.stat().st_size)), int(rng.integers(8))
        flip(path, at, bit)
        report = verify(data, "full")
        flip(path, at, bit)
        tried[path.relative_to(data).parts[0]] += 1
        if report.ok:
            missed.append(f"bit {bit} of byte {at} of {path.relative_to(data)}")
    return {
        "flips": flips,
        "found": flips - len(missed),
        "missed": missed,
        "where": dict(tried),
        "untouched_ok": verify(data, "full").ok,
        "gigabytes": round(sum(p.stat().st_size for p in rounds) / 1e9, 3),
        "seconds": round(time.perf_counter() - started, 1),
        "reached": not missed,
    }


def main(
    flips: int = 1000, seed: int = 0, data: Path | None = None, json: Path | None = None
) -> None:
    with tempfile.TemporaryDirectory() as home:
        copy = Path(home) / "data"
        if data is None:
            collect_few(copy, rounds=3, frames=100)
        else:
            shutil.copytree(data, copy)
        result = flip_bits(copy, flips, seed)
    conclude(result, json, bool(result["reached"] and result["untouched_ok"]))


if __name__ == "__main__":
    run_command(main)
