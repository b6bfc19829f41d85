"""Controllers for an hour, while the service is restarted and given other models under them.

    python benchmarks/endurance.py [--minutes 60] [--attacks] [--out FILE]

Eight clients ask at 20 Hz each; a rolling restart every five minutes and a reload every minute, of
two models by turns. Claims: no admitted request is lost (every request is answered or refused, and
the clients have all answers that the service counts), and no answer is of the wrong model: each is
bit-equal to what the model that it names says of that image, and that model was, while the request
was under way, the one to answer.

`--attacks`: no restarts, no reloads, but bad clients beside the good ones, which make all attacks
of the tests in every minute (two hours: --minutes 120). Claims: nothing is lost and no answer is
wrong, the service's memory in the last minute is at most 1 % over that in the first, and p99 after
the first minute is at most 1.2 times that in it. A minute before the first is not counted.
"""

import argparse
import json
import os
import re
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from statistics import median, quantiles
from typing import Any
from urllib.request import urlopen

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))

from benchmarks.material.bad_clients import bad_clients
from benchmarks.material.servers import OURS, descendants, running
from mtlnet.inference.engine import load_engine
from mtlnet.inference.image_decoding.decode import decode, inspect
from mtlnet.inference.model_card import read_card
from mtlnet.inference.prediction import decode_outputs
from serve.client import Client, ServiceError
from serve.workers.control_socket import send_command
from tests.serve.attacks.conftest import resident_mb
from tests.serve.conftest import jpeg, picture, publish_untrained

CLIENTS, HERTZ, WORKERS = 8, 20.0, 2
RELOAD_S, RESTART_S = 60.0, 300.0
IMAGES = 16
GROWTH, SLOWER = 0.01, 1.2
MINUTE_S = 60.0
PART_S = 10 * MINUTE_S
"""A long run is also told in parts."""
COUNTED = re.compile(r'^driverview_frames_total\{.*outcome="answered".*\} ([0-9.e+]+)$', re.M)

Known = dict[str, list[dict[str, Any]]]  # model hash -> its answers to the images


@dataclass
class Reign:
    """Which models may have answered when: `begun` and `ended` are those of each reload."""

    first: str
    changes: list[tuple[float, float, str]] = field(default_factory=list)

    def allowed(self, sent: float, answered: float) -> set[str]:
        """The models that may answer a request under way from `sent` to `answered`."""
        now, models = self.first, set()
        since = -1.0
        for begun, ended, model in [*self.changes, (float("inf"), float("inf"), "")]:
            if sent < ended and answered > since:
                models.add(now)
            now, since = model, begun
        return models


@dataclass
class Told:
    """What one client was told.

    An answer is kept as the times at which its request was sent and it came, the model that it
    names, and whether it is bit-equal to what that model says of the image. The answers of two
    hours as they came would fill gigabytes.
    """

    answers: list[tuple[float, float, str, bool]] = field(default_factory=list)
    refused: Counter[str] = field(default_factory=Counter)
    lost: list[str] = field(default_factory=list)
    missed: int = 0


def drive(
    port: int, number: int, images: list[bytes], known: Known, end: float, told: Told
) -> None:
    """Ask at 20 Hz until `end`; clients begin spread over a period."""
    begin = time.monotonic() + number / CLIENTS / HERTZ
    with Client(f"127.0.0.1:{port}", timeout_s=10.0) as client:
        turn = 0
        while (due := begin + turn / HERTZ) < end:
            time.sleep(max(due - time.monotonic(), 0.0))
            which = (turn + number) % len(images)
            sent = time.monotonic()
            try:
                answer = client.features(images[which])
                came = time.monotonic()
                told.answers.append((sent, came, answer["model"], is_right(answer, which, known)))
            except ServiceError as error:
                if error.status is None:
                    told.lost.append(str(error))
                else:
                    told.refused[str(error.problem)] += 1
            # What it could not ask in time it asks no more, as a camera takes no frame twice.
            now = max(turn + 1, int((time.monotonic() - begin) * HERTZ))
            told.missed += now - turn - 1
            turn = now


@contextmanager
def clients(
    port: int, images: list[bytes], known: Known, end: float, told: list[Told]
) -> Iterator[None]:
    """A client for each of `told`, asking until `end`, which is waited for; raises what they do."""
    with ThreadPoolExecutor(len(told)) as pool:
        asking = [
            pool.submit(drive, port, number, images, known, end, one)
            for number, one in enumerate(told)
        ]
        yield
        for client in asking:
            client.result()


def disturb(port: int, runs: list[Path], reign: Reign, end: float) -> Counter[str]:
    """Reload and restart on time until `end`; how often."""
    done: Counter[str] = Counter()
    begin = time.monotonic()
    plans: dict[str, tuple[float, Callable[[], object]]] = {
        "reload": (RELOAD_S, lambda: _reload(port, runs[(done["reload"] + 1) % 2], reign)),
        "restart": (RESTART_S, lambda: send_command(port, "restart")),
    }
    while True:
        due, name = min((begin + (done[n] + 1) * every, n) for n, (every, _) in plans.items())
        if due >= end:
            return done
        time.sleep(max(due - time.monotonic(), 0.0))
        plans[name][1]()
        done[name] += 1


def _reload(port: int, run: Path, reign: Reign) -> None:
    begun = time.monotonic()
    send_command(port, "reload", str(run))
    reign.changes.append((begun, time.monotonic(), read_card(run).model_hash))


def answers_of(run: Path, images: list[bytes]) -> list[dict[str, Any]]:
    """What the model of `run` says of the images, asked without a service."""
    engine = load_engine(run)
    camera = engine.card.camera
    return [
        decode_outputs(engine(decode(image, inspect(image, camera), camera))).as_json()
        for image in images
    ]


def is_right(answer: dict[str, Any], which: int, known: Known) -> bool:
    """Whether an answer is what the model that it names says of the image by itself."""
    if answer["model"] not in known:
        return False
    right = known[answer["model"]][which]
    return {key: answer[key] for key in right} == right


def wrong(told: Told, reign: Reign) -> list[str]:
    """The answers that are not what they ought to be."""
    found = []
    for sent, answered, model, right in told.answers:
        if model not in reign.allowed(sent, answered):
            found.append(f"model {model[:12]} answered at {sent:.3f} s out of its time")
        if not right:
            found.append(f"model {model[:12]} answered at {sent:.3f} s otherwise than by itself")
    return found


def measure(minutes: float, folder: Path) -> dict[str, Any]:
    """The figures of a run."""
    images = [jpeg(np.roll(picture(), 17 * number, axis=1)) for number in range(IMAGES)]
    runs = [folder / "one", folder / "other"]
    for seed, run in enumerate(runs):
        publish_untrained(run, seed=seed + 3)
    known = {read_card(run).model_hash: answers_of(run, images) for run in runs}
    reign = Reign(read_card(runs[0]).model_hash)
    told = [Told() for _ in range(CLIENTS)]
    with running(OURS, Path(sys.executable), runs[0], WORKERS) as port:
        before = counted(port)
        end = time.monotonic() + MINUTE_S * minutes
        with clients(port, images, known, end, told):
            done = disturb(port, runs, reign, end)
        after = counted(port)
    answers = sum(len(one.answers) for one in told)
    times_ms = [1e3 * (b - a) for one in told for a, b, _, _ in one.answers]
    faults = [fault for one in told for fault in [*one.lost, *wrong(one, reign)]]
    return {
        "minutes": minutes,
        **done,
        "answers": answers,
        "answers_counted_by_the_service": after - before,
        "refused": dict(sum((one.refused for one in told), Counter())),
        "models": dict(Counter(model for one in told for _, _, model, _ in one.answers)),
        "turns_missed": sum(one.missed for one in told),
        "p50_ms": round(median(times_ms), 2),
        "p99_ms": round(quantiles(times_ms, n=100)[98], 2),
        "faults": faults[:10],
        "reached": not faults and answers == after - before,
    }


@dataclass
class Memory:
    """The resident memory of some processes, MB, by time; a process that has ended is a fault."""

    pids: list[int]
    samples: list[tuple[float, float]] = field(default_factory=list)
    fault: str = ""

    def watch(self, end: float) -> None:
        """Look once a second until `end`; tell every ten minutes."""
        tell = time.monotonic() + PART_S
        while (now := time.monotonic()) < end and not self.fault:
            if now >= tell:
                tell += PART_S
                megabytes = self.median(now - MINUTE_S, now)
                print(f"{(end - now) / MINUTE_S:.0f} min left: {megabytes:.1f} MB", file=sys.stderr)
            try:
                found = sum(resident_mb(pid) for pid in self.pids)
            except OSError as error:
                self.fault = f"a process of the service has ended ({error.filename})"
                return
            self.samples.append((time.monotonic(), found))
            time.sleep(1.0)

    def median(self, begin: float, end: float) -> float:
        """Of the samples in a part of the time, MB."""
        return median(mb for when, mb in self.samples if begin <= when < end)


def measure_attacked(minutes: float, folder: Path) -> dict[str, Any]:
    """The figures of a run beside bad clients."""
    images = [jpeg(np.roll(picture(), 17 * number, axis=1)) for number in range(IMAGES)]
    run = folder / "run"
    publish_untrained(run, seed=3)
    model = read_card(run).model_hash
    known, reign = {model: answers_of(run, images)}, Reign(model)
    told = [Told() for _ in range(CLIENTS)]
    with running(OURS, Path(sys.executable), run, WORKERS) as port:
        memory = Memory(descendants(os.getpid()))
        with bad_clients(port):
            begin = time.monotonic() + MINUTE_S
            end = begin + MINUTE_S * minutes
            with clients(port, images, known, end, told):
                memory.watch(end)
    return {"minutes": minutes, **judge_attacked(told, memory, reign, begin, end)}


def judge_attacked(
    told: list[Told], memory: Memory, reign: Reign, begin: float, end: float
) -> dict[str, Any]:
    """The figures from `begin` to `end`, and whether they are as claimed."""
    faults = [fault for one in told for fault in [*one.lost, *wrong(one, reign)]]
    faults += [memory.fault] if memory.fault else []
    answers = [(sent, 1e3 * (done - sent)) for one in told for sent, done, _, _ in one.answers]
    refused = sum((one.refused for one in told), Counter())
    first = [ms for sent, ms in answers if begin <= sent < begin + MINUTE_S]
    later = [ms for sent, ms in answers if sent >= begin + MINUTE_S]
    p99s = [quantiles(part, n=100)[98] for part in (first, later)]
    megabytes = [memory.median(begin, begin + MINUTE_S), memory.median(end - MINUTE_S, end)]
    growth, slower = megabytes[1] / megabytes[0] - 1.0, p99s[1] / p99s[0]
    parts = [begin + PART_S * number for number in range(int((end - begin) / PART_S))]
    return {
        "answers": len(answers),
        "answered_share": round(len(answers) / (len(answers) + refused.total()), 5),
        "refused": dict(refused),
        "turns_missed": sum(one.missed for one in told),
        "p99_ms_first_minute": round(p99s[0], 2),
        "p99_ms_later": round(p99s[1], 2),
        "slower": round(slower, 3),
        "memory_mb_first_minute": round(megabytes[0], 1),
        "memory_mb_last_minute": round(megabytes[1], 1),
        "growth": round(growth, 4),
        "memory_mb_of_ten_minutes": [round(memory.median(p, p + PART_S), 1) for p in parts],
        "p99_ms_of_ten_minutes": [
            round(quantiles([ms for sent, ms in answers if p <= sent < p + PART_S], n=100)[98], 1)
            for p in parts
        ],
        "faults": faults[:10],
        "reached": not faults and growth <= GROWTH and slower <= SLOWER,
    }


def counted(port: int) -> int:
    """The frames that the service says it answered, in all workers."""
    with urlopen(f"http://127.0.0.1:{port}/metrics") as page:
        found = COUNTED.findall(page.read().decode())
    return round(sum(map(float, found)))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--minutes", type=float, default=60.0)
    parser.add_argument("--attacks", action="store_true", help="beside bad clients")
    parser.add_argument("--out", type=Path, help="write the figures here, too")
    options = parser.parse_args()
    if options.attacks and options.minutes < 2:
        parser.error("the last minute is compared with the first: give --minutes 2 or more")
    with tempfile.TemporaryDirectory() as folder:
        made = measure_attacked if options.attacks else measure
        result = made(options.minutes, Path(folder))
    text = json.dumps(result, indent=1)
    print(text)
    if options.out:
        options.out.write_text(f"{text}\n")
    sys.exit(0 if result["reached"] else 1)


if __name__ == "__main__":
    main()
