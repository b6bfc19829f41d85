"""Kill -9 of the whole process tree at random moments of a collection: nothing finished is lost.

Run: `python benchmarks/killed.py [--kills 200] [--rounds 8] [--frames 20] [--json FILE]`. A run of
`datagen collect` is killed at a random moment and started again, until it is through; then another
folder is begun, until there were so many kills. Claim: every round that was finished at a kill
still has the same bytes and time of writing at the end, and every dataset has the hash of an
undisturbed run.
"""

import argparse
import hashlib
import json
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

TRACKS = "oval,circuit"
WARM_UP = ("--rounds", "2", "--frames", "2")
LONGEST_PART = 1.3
"""Kills come within so many times the length of an undisturbed run; later ones come too late."""

Finished = dict[str, tuple[str, int]]


@dataclass
class Count:
    kills: int = 0
    folders: int = 0
    finished_at_kills: list[int] = field(default_factory=list)
    lost: list[str] = field(default_factory=list)
    wrong_hash: list[str] = field(default_factory=list)
    not_in_order: list[str] = field(default_factory=list)


def command(out: Path, options: tuple[str, ...]) -> list[str]:
    return [
        *(sys.executable, "-m", "datagen", "collect", "--tracks", TRACKS, "--workers", "2"),
        *(*options, "--json", "--out", str(out)),
    ]


def collect(out: Path, options: tuple[str, ...]) -> float:
    """Undisturbed; seconds."""
    started = time.monotonic()
    subprocess.run(command(out, options), check=True, capture_output=True)
    return time.monotonic() - started


def collect_until(out: Path, options: tuple[str, ...], seconds: float) -> bool:
    """Kill the tree after so long; True when it was through before."""
    process = subprocess.Popen(
        command(out, options),
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
    )
    try:
        code = process.wait(seconds)
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, signal.SIGKILL)
        process.wait()
        return False
    if code != 0:
        raise RuntimeError(f"a resumed collection ended with code {code}")
    return True


def finished(out: Path) -> Finished:
    """Hash and time of writing of every round that has its state."""
    found = {}
    for state in out.glob("state/*.json"):
        path = out / "rounds" / f"{state.stem}.mcap"
        digest = hashlib.sha256(path.read_bytes()).hexdigest()
        found[state.stem] = (digest, path.stat().st_mtime_ns)
    return found


def content_hash(out: Path) -> tuple[str, bool]:
    """The dataset's hash and whether `verify --level full` finds it in order."""
    done = subprocess.run(
        [sys.executable, "-m", "datagen", "verify", str(out), "--level", "full", "--json"],
        capture_output=True,
        text=True,
    )
    report = json.loads(done.stdout)
    return str(report["content_hash"]), bool(report["ok"])


def kill_and_resume(
    home: Path, options: tuple[str, ...], kills: int, rng: random.Random, seconds: float
) -> Count:
    count = Count()
    expected, _ = content_hash(home / "undisturbed")
    files = {name: digest for name, (digest, _) in finished(home / "undisturbed").items()}
    while count.kills < kills:
        out = home / f"killed-{count.folders}"
        count.folders += 1
        before: Finished = {}
        through = False
        while not through:
            # After the last kill the collection is left to end.
            last = count.kills >= kills
            moment = 3600.0 if last else rng.uniform(0.0, LONGEST_PART * seconds)
            through = collect_until(out, options, moment)
            now = finished(out)
            count.lost += [f"{out.name}/{name}" for name in before if now.get(name) != before[name]]
            if not through:
                count.kills += 1
                count.finished_at_kills.append(len(now))
            before = now
        found, in_order = content_hash(out)
        if found != expected or {name: digest for name, (digest, _) in before.items()} != files:
            count.wrong_hash.append(out.name)
        if not in_order:
            count.not_in_order.append(out.name)
        print(f"{count.kills} kills, {count.folders} datasets whole again", file=sys.stderr)
    return count


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--kills", type=int, default=200)
    parser.add_argument("--rounds", type=int, default=8)
    parser.add_argument("--frames", type=int, default=20)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    options = ("--rounds", str(arguments.rounds), "--frames", str(arguments.frames))
    with tempfile.TemporaryDirectory() as folder:
        home = Path(folder)
        collect(home / "warm-up", WARM_UP)  # the first time, code is compiled
        seconds = collect(home / "undisturbed", options)
        count = kill_and_resume(
            home, options, arguments.kills, random.Random(arguments.seed), seconds
        )
    result: dict[str, Any] = {
        "kills": count.kills,
        "datasets": count.folders,
        "undisturbed_s": round(seconds, 1),
        "kills_with_finished_rounds": sum(n > 0 for n in count.finished_at_kills),
        "finished_rounds_lost": count.lost,
        "datasets_with_another_hash": count.wrong_hash,
        "datasets_not_in_order": count.not_in_order,
    }
    result["reached"] = not (count.lost or count.wrong_hash or count.not_in_order)
    text = json.dumps(result, indent=1)
    print(text)
    if arguments.json:
        arguments.json.write_text(text + "\n")
    sys.exit(0 if result["reached"] else 1)


if __name__ == "__main__":
    main()
