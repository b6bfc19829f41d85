"""Compares a dataset that two Ray workers record on one host with a dataset that one process
records.

Run: `python benchmarks/ray_hash.py [--rounds 6] [--frames 200] [--json FILE]`. Claim: the hashes of
the datasets and the bytes of every round are equal. The result also has the time of both recordings
in s.
"""

import sys
import tempfile
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))

from benchmarks.claims.outcome import conclude, run_command
from benchmarks.recordings.enlarged import collect


def same_rounds(one: Path, other: Path) -> bool:
    """Whether the rounds of two datasets have the same names and bytes."""
    first, second = (
        {path.name: path.read_bytes() for path in (folder / "rounds").iterdir()}
        for folder in (one, other)
    )
    return first == second


def main(rounds: int = 6, frames: int = 200, json: Path | None = None) -> None:
    with tempfile.TemporaryDirectory() as folder:
        one, two = Path(folder) / "one-process", Path(folder) / "two-ray-workers"
        alone = collect(one, rounds=rounds, frames=frames, workers=1)
        ray = collect(two, rounds=rounds, frames=frames, workers=2, executor="ray")
        bytes_equal = same_rounds(one, two)
    reached = bytes_equal and alone["content_hash"] == ray["content_hash"]
    result = {
        "rounds": alone["rounds"],
        "one_process_s": alone["seconds"],
        "two_ray_workers_s": ray["seconds"],
        "content_hash": alone["content_hash"],
        "reached": reached,
    }
    conclude(result, json, reached)


if __name__ == "__main__":
    run_command(main)
