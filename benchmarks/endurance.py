"""The service under load for an hour, with restarts and changes of the model, or with attacks.

    python benchmarks/endurance.py [--minutes 60] [--attacks] [--out FILE]

Eight clients send 20 requests per second each. The workers are replaced every five minutes. The
model is reloaded every minute, alternately from two runs. Claims: no admitted request is lost
(every request is answered or refused, and the clients receive as many answers as the service
counts), and no answer is wrong. An answer is right if it is bit-equal to the prediction of the
model that it names, and if this model was loaded at some moment between request and answer.

With `--attacks` there are no restarts and no reloads. Malicious clients make all attacks of the
tests once per minute (for two hours: --minutes 120). Claims: no request is lost, no answer is
wrong, the memory of the service in the last minute is at most 1 % above its memory in the first
minute, and the p99 of the answers after the first minute is at most 1.2 times the p99 in the first
minute. The first minute begins after a minute of warm-up.
"""

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

from benchmarks.claims.outcome import conclude, run_command
from benchmarks.service_load.malicious_clients import malicious_clients
from benchmarks.service_load.servers import OURS, descendants, running
from mtlnet.inference.engine import load_engine
from mtlnet.inference.image_decoding.decode import crop_and_resize, decode_whole, read_header
from mtlnet.inference.model_card import read_card
from mtlnet.inference.prediction import decode_outputs
from serve.client import Client, ServiceError
from serve.workers.control_socket import send_command
from tests.serve.attacks.conftest import resident_mb
from tests.serve.conftest import jpeg, picture, publish_untrained
from trackfeatures.errors import UserError

CLIENTS, HERTZ, WORKERS = 8, 20.0, 2
RELOAD_S, RESTART_S = 60.0, 300.0
IMAGES = 16
GROWTH, SLOWER = 0.01, 1.2
MINUTE_S = 60.0
PART_S = 10 * MINUTE_S
"""The figures of a long run are also reported for parts of this length (s)."""
COUNTED = re.compile(r'^driverview_frames_total\{.*outcome="answered".*\} ([0-9.e+]+)$', re.M)

ExpectedAnswers = dict[str, list[dict[str, Any]]]  # model hash -> its answers to the images


@dataclass
class ModelHistory:
    """The models that were loaded: the hash of the first model, and (begin, end, hash of the new
    model) of each reload. Times are in s, by `time.monotonic()`."""

    first: str
    reloads: list[tuple[float, float, str]] = field(default_factory=list)

    def allowed(self, sent: float, received: float) -> set[str]:
        """Return the hashes of the models that were loaded at some moment between the times `sent`
        and `received` (s)."""
        model, models = self.first, set()
        since = -1.0
        for begin, end, next_model in [*self.reloads, (float("inf"), float("inf"), "")]:
            if sent < end and received > since:
                models.add(model)
            model, since = next_model, begin
        return models


@dataclass
class ClientLog:
    """The answers that one client received.

    An entry of `answers` has the times of request and answer (s), the hash of the model, and
    whether the answer is bit-equal to the model's prediction. Whole answers are not kept, because
    the answers of two hours would take gigabytes. `missed` counts requests that were left out,
    because they could not be sent in time.
    """

    answers: list[tuple[float, float, str, bool]] = field(default_factory=list)
    refused: Counter[str] = field(default_factory=Counter)
    lost: list[str] = field(default_factory=list)
    missed: int = 0


def send_requests(
    port: int,
    number: int,
    images: list[bytes],
    expected: ExpectedAnswers,
    end: float,
    log: ClientLog,
) -> None:
    """Send requests at 20 Hz until `end` (s, monotonic) and write the answers to `log`.

    Client `number` starts later by the share `number` / CLIENTS of a period, so that the clients do
    not all send at the same time.
    """
    begin = time.monotonic() + number / CLIENTS / HERTZ
    with Client(f"127.0.0.1:{port}", timeout_s=10.0) as client:
        turn = 0
        while (due := begin + turn / HERTZ) < end:
            time.sleep(max(due - time.monotonic(), 0.0))
            which = (turn + number) % len(images)
            sent = time.monotonic()
            try:
                answer = client.features(images[which])
                received = time.monotonic()
                correct = is_correct(answer, which, expected)
                log.answers.append((sent, received, answer["model"], correct))
            except ServiceError as error:
                if error.status is None:
                    log.lost.append(str(error))
                else:
                    log.refused[str(error.problem)] += 1
            # Requests that could not be sent in time are left out, as a camera drops frames.
            now = max(turn + 1, int((time.monotonic() - begin) * HERTZ))
            log.missed += now - turn - 1
            turn = now


@contextmanager
def clients(
    port: int, images: list[bytes], expected: ExpectedAnswers, end: float, logs: list[ClientLog]
) -> Iterator[None]:
    """Run a client for each log until `end` (s, monotonic). When the context ends, wait for the
    clients and raise their errors."""
    with ThreadPoolExecutor(len(logs)) as pool:
        running_clients = [
            pool.submit(send_requests, port, number, images, expected, end, log)
            for number, log in enumerate(logs)
        ]
        yield
        for client in running_clients:
            client.result()


def reload_and_restart(
    port: int, runs: list[Path], history: ModelHistory, end: float
) -> Counter[str]:
    """Reload the model every minute and restart the workers every five minutes until `end`.

    Returns the numbers of reloads and of restarts.
    """
    done: Counter[str] = Counter()
    begin = time.monotonic()
    plans: dict[str, tuple[float, Callable[[], object]]] = {
        "reload": (RELOAD_S, lambda: _reload(port, runs[(done["reload"] + 1) % 2], history)),
        "restart": (RESTART_S, lambda: send_command(port, "restart")),
    }
    while True:
        due, name = min((begin + (done[n] + 1) * every, n) for n, (every, _) in plans.items())
        if due >= end:
            return done
        time.sleep(max(due - time.monotonic(), 0.0))
        plans[name][1]()
        done[name] += 1


def _reload(port: int, run: Path, history: ModelHistory) -> None:
    begin = time.monotonic()
    send_command(port, "reload", str(run))
    history.reloads.append((begin, time.monotonic(), read_card(run).model_hash))


def expected_answers(run: Path, images: list[bytes]) -> list[dict[str, Any]]:
    """Return the answers (JSON) of the model in the folder `run` to the images. They are computed
    in this process."""
    engine = load_engine(run)
    camera = engine.card.camera
    return [
        decode_outputs(
            engine(crop_and_resize(decode_whole(image, read_header(image)), camera))
        ).as_json()
        for image in images
    ]


def is_correct(answer: dict[str, Any], which: int, expected: ExpectedAnswers) -> bool:
    """Whether an answer to image number `which` is bit-equal to the prediction of its model."""
    if answer["model"] not in expected:
        return False
    prediction = expected[answer["model"]][which]
    return {key: answer[key] for key in prediction} == prediction


def wrong_answers(log: ClientLog, history: ModelHistory) -> list[str]:
    """Return a message for each answer whose model was not loaded at the time, or that differs from
    the prediction of its model."""
    found = []
    for sent, received, model, correct in log.answers:
        if model not in history.allowed(sent, received):
            found.append(f"at {sent:.3f} s: answered by model {model[:12]}, which was not loaded")
        if not correct:
            found.append(f"at {sent:.3f} s: not what model {model[:12]} predicts")
    return found


def measure(minutes: float, folder: Path) -> dict[str, Any]:
    """Run the clients with reloads and restarts for `minutes`; return the figures.

    `folder` is for the two models.
    """
    images = [jpeg(np.roll(picture(), 17 * number, axis=1)) for number in range(IMAGES)]
    runs = [folder / "one", folder / "other"]
    for seed, run in enumerate(runs):
        publish_untrained(run, seed=seed + 3)
    expected = {read_card(run).model_hash: expected_answers(run, images) for run in runs}
    history = ModelHistory(read_card(runs[0]).model_hash)
    logs = [ClientLog() for _ in range(CLIENTS)]
    with running(OURS, Path(sys.executable), runs[0], WORKERS) as port:
        before = counted(port)
        end = time.monotonic() + MINUTE_S * minutes
        with clients(port, images, expected, end, logs):
            done = reload_and_restart(port, runs, history, end)
        after = counted(port)
    answers = sum(len(log.answers) for log in logs)
    times_ms = [1e3 * (b - a) for log in logs for a, b, _, _ in log.answers]
    faults = [fault for log in logs for fault in [*log.lost, *wrong_answers(log, history)]]
    return {
        "minutes": minutes,
        **done,
        "answers": answers,
        "answers_counted_by_the_service": after - before,
        "refused": dict(sum((log.refused for log in logs), Counter())),
        "models": dict(Counter(model for log in logs for _, _, model, _ in log.answers)),
        "turns_missed": sum(log.missed for log in logs),
        "p50_ms": round(median(times_ms), 2),
        "p99_ms": round(quantiles(times_ms, n=100)[98], 2),
        "faults": faults[:10],
        "reached": not faults and answers == after - before,
    }


@dataclass
class Memory:
    """Samples (time in s, MB) of the resident memory of the processes `pids`, summed over them.

    `fault` is a message if one of the processes has ended.
    """

    pids: list[int]
    samples: list[tuple[float, float]] = field(default_factory=list)
    fault: str = ""

    def watch(self, end: float) -> None:
        """Take a sample every second until `end`; print the memory every ten minutes."""
        report = time.monotonic() + PART_S
        while (now := time.monotonic()) < end and not self.fault:
            if now >= report:
                report += PART_S
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
        """Median of the samples from `begin` to `end` (s), in MB."""
        return median(mb for when, mb in self.samples if begin <= when < end)


def measure_attacked(minutes: float, folder: Path) -> dict[str, Any]:
    """Run the clients together with malicious clients for `minutes`; return the figures."""
    images = [jpeg(np.roll(picture(), 17 * number, axis=1)) for number in range(IMAGES)]
    run = folder / "run"
    publish_untrained(run, seed=3)
    model = read_card(run).model_hash
    expected, history = {model: expected_answers(run, images)}, ModelHistory(model)
    logs = [ClientLog() for _ in range(CLIENTS)]
    with running(OURS, Path(sys.executable), run, WORKERS) as port:
        memory = Memory(descendants(os.getpid()))
        with malicious_clients(port):
            begin = time.monotonic() + MINUTE_S
            end = begin + MINUTE_S * minutes
            with clients(port, images, expected, end, logs):
                memory.watch(end)
    return {"minutes": minutes, **attacked_figures(logs, memory, history, begin, end)}


def attacked_figures(
    logs: list[ClientLog], memory: Memory, history: ModelHistory, begin: float, end: float
) -> dict[str, Any]:
    """Return the figures of the time from `begin` to `end` (s, monotonic), and whether the claims
    are reached."""
    faults = [fault for log in logs for fault in [*log.lost, *wrong_answers(log, history)]]
    faults += [memory.fault] if memory.fault else []
    answers = [(sent, 1e3 * (done - sent)) for log in logs for sent, done, _, _ in log.answers]
    refused = sum((log.refused for log in logs), Counter())
    first = [ms for sent, ms in answers if begin <= sent < begin + MINUTE_S]
    later = [ms for sent, ms in answers if sent >= begin + MINUTE_S]
    p99s = [quantiles(part, n=100)[98] for part in (first, later)]
    megabytes = [memory.median(begin, begin + MINUTE_S), memory.median(end - MINUTE_S, end)]
    growth, slower = megabytes[1] / megabytes[0] - 1.0, p99s[1] / p99s[0]
    parts = [begin + PART_S * number for number in range(int(round(end - begin) // PART_S))]
    return {
        "answers": len(answers),
        "answered_share": round(len(answers) / (len(answers) + refused.total()), 5),
        "refused": dict(refused),
        "turns_missed": sum(log.missed for log in logs),
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
    """The number of answered frames in all workers, read from the service's /metrics."""
    with urlopen(f"http://127.0.0.1:{port}/metrics") as page:
        found = COUNTED.findall(page.read().decode())
    return round(sum(map(float, found)))


def main(minutes: float = 60.0, attacks: bool = False, out: Path | None = None) -> None:
    if attacks and minutes < 2:
        raise UserError("the last minute is compared with the first: give --minutes 2 or more")
    with tempfile.TemporaryDirectory() as folder:
        made = measure_attacked if attacks else measure
        result = made(minutes, Path(folder))
    conclude(result, out, result["reached"])


if __name__ == "__main__":
    run_command(main)
