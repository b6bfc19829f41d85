"""Kills the processes of a collection at random moments and checks that no finished round is lost.

Run: `python benchmarks/collect_killed.py [--kills 200] [--rounds 8] [--frames 20] [--seed 1]
[--json FILE]`. A run of `datagen collect` is killed (SIGKILL for all its processes) at a random
moment and started again, until the dataset is complete. This is repeated with new folders until
the number of kills is reached. Claim: every round that was finished before a kill still has the
same bytes and modification time at the end, and every dataset has the hash of an undisturbed run.

A third of the kills come at a random time of the run; most of a run is start-up. All other kills
come within a short random time after a change in the folder: a round is begun, a round is renamed,
a round gets its state file, or the last round is finished. `phases` in the result counts the states
in which the kills left the folder.
"""

import hashlib
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from json import loads
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1]))

from benchmarks.claims.outcome import conclude, run_command
from runtime.files import unfinished_path

TRACKS = "oval,circuit"
WARM_UP = ("--rounds", "2", "--frames", "2")
LONGEST_PART = 1.3
"""Latest time of a kill, as a multiple of the duration of an undisturbed run."""

POLL_S = 0.001

Finished = dict[str, tuple[str, int]]  # round -> (SHA-256, modification time in ns)
Occurred = Callable[[Path], int]  # returns how often an event has occurred in a folder so far


@dataclass(frozen=True)
class Event:
    """A change in the folder of a collection; a kill follows at most `within_s` after it."""

    occurred: Occurred
    within_s: float


EVENTS = {
    "begun": Event(lambda out: _number(out, ".partial/*/round.mcap"), 0.6),
    "named": Event(lambda out: _number(out, "rounds/*.mcap"), 0.01),
    "stated": Event(lambda out: _number(out, "state/*.json"), 0.02),
}


@dataclass(frozen=True)
class Moment:
    """The moment of a kill: `seconds` after the start of the collection or, if `event` is given,
    `seconds` after the event has occurred `times` times."""

    seconds: float
    event: Event | None = None
    times: int = 0

    @staticmethod
    def draw(rng: random.Random, seconds: float, rounds: int, done: int) -> "Moment":
        kind = rng.choice(["any", "any", *EVENTS, "last"])
        if kind == "any" or done == rounds:
            return Moment(rng.uniform(0.0, LONGEST_PART * seconds))
        if kind == "last":  # statistics, split, card and manifest follow the last round
            return Moment(rng.uniform(0.0, 0.6), EVENTS["stated"], rounds - done)
        event = EVENTS[kind]
        return Moment(rng.uniform(0.0, event.within_s), event, rng.randint(1, 3))


@dataclass
class Count:
    kills: int = 0
    phases: Counter[str] = field(default_factory=Counter)
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
    """Collect into `out` without a kill; return the seconds that it took."""
    started = time.monotonic()
    subprocess.run(command(out, options), check=True, capture_output=True)
    return time.monotonic() - started


def collect_until(out: Path, options: tuple[str, ...], moment: Moment) -> str:
    """Collect into `out` and kill all processes at `moment`. Return the phase in which they were
    killed.

    Returns "" if the collection ended before `moment`. Raises RuntimeError if the collection ended
    with an error.
    """
    process = subprocess.Popen(
        command(out, options),
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
    )
    if moment.event:
        await_event(process, out, moment.event, moment.times)
    try:
        code = process.wait(moment.seconds)
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, signal.SIGKILL)
        process.wait()
        return phase(out)
    if code != 0:
        raise RuntimeError(f"a resumed collection ended with code {code}")
    return ""


def await_event(process: subprocess.Popen[bytes], out: Path, event: Event, times: int) -> None:
    """Wait until `event` has occurred `times` more times, or the collection has ended."""
    seen = event.occurred(out)
    while times > 0 and process.poll() is None:
        now = event.occurred(out)  # falls when the collection removes leftovers
        times -= max(now - seen, 0)
        seen = now
        time.sleep(POLL_S)


def phase(out: Path) -> str:
    """Return the phase in which a collection was killed, derived from the files in its folder
    `out`."""
    if not (out / "plan.json").is_file():
        return "planning"
    partial = [file.stat().st_size for file in out.glob(".partial/*/round.mcap")]
    if any(not (out / f"state/{r.stem}.json").is_file() for r in out.glob("rounds/*.mcap")):
        return "renaming"
    if any(out.rglob(unfinished_path(Path("?*")).name)):
        return "writing a small file"
    if any(partial):
        return "recording or checking"
    if partial or _number(out, ".partial/*"):
        return "beginning a round"
    planned = len(loads((out / "plan.json").read_text())["rounds"])
    return "deriving" if _number(out, "state/*.json") == planned else "starting up"


def _number(out: Path, pattern: str) -> int:
    return sum(1 for _ in out.glob(pattern))


def finished(out: Path) -> Finished:
    """Return the SHA-256 and the modification time (ns) of every finished round in `out`, by the
    round's name. A finished round has a state file."""
    found = {}
    for state in out.glob("state/*.json"):
        path = out / "rounds" / f"{state.stem}.mcap"
        digest = hashlib.sha256(path.read_bytes()).hexdigest()
        found[state.stem] = (digest, path.stat().st_mtime_ns)
    return found


def content_hash(out: Path) -> tuple[str, bool]:
    """Return the content hash of the dataset in `out`, and whether `datagen verify --level full`
    finds no problem in it."""
    done = subprocess.run(
        [sys.executable, "-m", "datagen", "verify", str(out), "--level", "full", "--json"],
        capture_output=True,
        text=True,
    )
    report = loads(done.stdout)
    return str(report["content_hash"]), bool(report["ok"])


def kill_and_resume(
    home: Path, options: tuple[str, ...], kills: int, rng: random.Random, seconds: float
) -> Count:
    rounds = len(finished(home / "undisturbed"))
    count = Count()
    expected, _ = content_hash(home / "undisturbed")
    files = {name: digest for name, (digest, _) in finished(home / "undisturbed").items()}
    while count.kills < kills:
        out = home / f"killed-{count.folders}"
        count.folders += 1
        before: Finished = {}
        through = False
        while not through:
            # After the last kill, the collection runs to its end.
            last = count.kills >= kills
            moment = Moment(3600) if last else Moment.draw(rng, seconds, rounds, len(before))
            killed_at = collect_until(out, options, moment)
            through = not killed_at
            now = finished(out)
            count.lost += [f"{out.name}/{name}" for name in before if now.get(name) != before[name]]
            if not through:
                count.kills += 1
                count.phases[killed_at] += 1
                count.finished_at_kills.append(len(now))
            before = now
        found, in_order = content_hash(out)
        if found != expected or {name: digest for name, (digest, _) in before.items()} != files:
            count.wrong_hash.append(out.name)
        if not in_order:
            count.not_in_order.append(out.name)
        print(f"{count.kills} kills, {count.folders} datasets whole again", file=sys.stderr)
    return count


def main(
    kills: int = 200, rounds: int = 8, frames: int = 20, seed: int = 1, json: Path | None = None
) -> None:
    options = ("--rounds", str(rounds), "--frames", str(frames))
    with tempfile.TemporaryDirectory() as folder:
        home = Path(folder)
        collect(home / "warm-up", WARM_UP)  # the first time, code is compiled
        seconds = collect(home / "undisturbed", options)
        count = kill_and_resume(home, options, kills, random.Random(seed), seconds)
    result: dict[str, Any] = {
        "kills": count.kills,
        "datasets": count.folders,
        "undisturbed_s": round(seconds, 1),
        "phases": dict(count.phases.most_common()),
        "kills_with_finished_rounds": sum(n > 0 for n in count.finished_at_kills),
        "finished_rounds_lost": count.lost,
        "datasets_with_another_hash": count.wrong_hash,
        "datasets_not_in_order": count.not_in_order,
    }
    reached = not (count.lost or count.wrong_hash or count.not_in_order)
    conclude({**result, "reached": reached}, json, reached)


if __name__ == "__main__":
    run_command(main)
