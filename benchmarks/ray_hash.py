"""Two Ray workers on one host give the same dataset as one process.

Run: `python benchmarks/ray_hash.py [--rounds 6] [--frames 200] [--json FILE]`. Claim: the dataset's
hash and the bytes of every round are the same; the seconds of both are printed.
"""

import argparse
import json
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any


def collect(out: Path, options: list[str]) -> dict[str, Any]:
    done = subprocess.run(
        [sys.executable, "-m", "datagen", "collect", "--json", "--out", str(out), *options],
        check=True,
        stdout=subprocess.PIPE,
        text=True,
    )
    result: dict[str, Any] = json.loads(done.stdout)
    return result


def same_rounds(one: Path, other: Path) -> bool:
    """Names and bytes."""
    first, second = (
        {path.name: path.read_bytes() for path in (folder / "rounds").iterdir()}
        for folder in (one, other)
    )
    return first == second


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", type=int, default=6)
    parser.add_argument("--frames", type=int, default=200)
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    options = ["--rounds", str(arguments.rounds), "--frames", str(arguments.frames)]
    with tempfile.TemporaryDirectory() as folder:
        one, two = Path(folder) / "one-process", Path(folder) / "two-ray-workers"
        alone = collect(one, [*options, "--workers", "1"])
        ray = collect(two, [*options, "--workers", "2", "--executor", "ray"])
        bytes_equal = same_rounds(one, two)
    result = {
        "rounds": alone["rounds"],
        "one_process_s": alone["seconds"],
        "two_ray_workers_s": ray["seconds"],
        "content_hash": alone["content_hash"],
        "reached": bytes_equal and alone["content_hash"] == ray["content_hash"],
    }
    text = json.dumps(result, indent=1)
    print(text)
    if arguments.json:
        arguments.json.write_text(text + "\n")
    sys.exit(0 if result["reached"] else 1)


if __name__ == "__main__":
    main()
