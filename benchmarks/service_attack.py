"""Measures the service under attack: the answers that a well-behaved client gets, and the memory
that the service uses.

Each attack of `tests.serve.attacks.registry` is repeated for `--seconds` by a process that knows
the token. Meanwhile another process sends ten requests per second over one connection, like a car.
Only services on loopback addresses are attacked; attacker and client have different addresses.

    python benchmarks/service_attack.py [--address 127.0.0.1:8000 --pid PID] [--seconds 60]
        [--settle 60] [--only NAME,NAME] [--model RUN] [--json] [--out FILE]
    claims for each attack: 99 of 100 requests are answered; p99 is at most three times the p99
    without an attack; memory is at most 60 MB plus the bodies' budget of 64 MiB above the memory
    without an attack, and at most 10 MB above it within `--settle` seconds after the attack

Without --address the benchmark starts a service with a new token. The token of a running service is
read from $DRIVERVIEW_TOKEN; `--pid` is the process id of its command `serve`.
"""

import http.client
import multiprocessing
import os
import secrets
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, replace
from json import dumps
from multiprocessing.synchronize import Event
from pathlib import Path
from statistics import quantiles
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1]))

from benchmarks.claims.outcome import exit_code, run_command
from benchmarks.service_load.malicious_clients import ADDRESS
from benchmarks.service_load.servers import descendants
from runtime.access import TOKEN_VARIABLE, is_loopback
from runtime.sockets import bind
from tests.serve.attacks.attacks import Attack
from tests.serve.attacks.conftest import Target, resident_mb
from tests.serve.attacks.registry import ATTACKS
from tests.serve.conftest import JPEG
from trackfeatures.errors import UserError

ANSWERED, SLOWER = 0.99, 3.0
BODIES_MB, GROWTH_MB, LEFT_MB = 67.2, 60.0, 10.0
RATE = 10.0  # requests per second of the well-behaved client
HOLD_S = 1.0  # time for which an attack keeps its connections open
QUIET_S = 20.0
SETTLE_S = 3.0  # least wait after each attack, in which the service frees memory
START_S = 120.0
SPAWN = multiprocessing.get_context("spawn")


@dataclass(frozen=True)
class Figures:
    """Result of one measurement: the number of requests of the well-behaved client, the share of
    them that was answered, the p50 and p99 of their times (ms), and the largest resident memory of
    the service (MB)."""

    requests: int
    answered: float
    p50_ms: float
    p99_ms: float
    most_mb: float


def ask(connection: http.client.HTTPConnection, token: str) -> bool:
    """Send one request, and send it a second time if the connection failed. Return whether the
    status was 200."""
    headers = {"Content-Type": "image/jpeg", "Authorization": f"Bearer {token}"}
    for _ in range(2):
        try:
            connection.request("POST", "/features", JPEG, headers)
            reply = connection.getresponse()
            reply.read()
        except (OSError, http.client.HTTPException):
            connection.close()
            continue
        return reply.status == 200
    return False


def behave(port: int, token: str, begun: Event, ended: Event, results: Any) -> None:
    """Send a request that is not counted and set `begun`. Then send RATE requests per second until
    `ended` is set. Put a list of (answered, ms), one for each request, into the queue `results`."""
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=10)
    ask(connection, token)
    begun.set()
    found, due_s = [], time.monotonic()
    while not ended.is_set():
        start_s = time.monotonic()
        good = ask(connection, token)
        found.append((good, 1e3 * (time.monotonic() - start_s)))
        due_s = max(due_s + 1.0 / RATE, time.monotonic() - 1.0)
        time.sleep(max(0.0, due_s - time.monotonic()))
    results.put(found)


def repeat(attack: Attack, target: Target, seconds: float, begun: Event) -> None:
    """Repeat `attack` on the service `target` for `seconds`. Set `begun` before the first
    attack."""
    begun.set()
    end_s = time.monotonic() + seconds
    while time.monotonic() < end_s:
        held = []
        with suppress(OSError, AssertionError):  # the service refused it, which is correct
            held = attack(target)
        time.sleep(HOLD_S)
        for connection in held:
            connection.close()


def measure(target: Target, pid: int, seconds: float, attack: Attack | None) -> Figures:
    """Run the well-behaved client for `seconds`, together with `attack` unless it is None. `pid` is
    the process of the service."""
    begun, attacked, ended = SPAWN.Event(), SPAWN.Event(), SPAWN.Event()
    results, attacker = SPAWN.Queue(), None
    arguments = (target.port, target.token or "", begun, ended, results)
    client = SPAWN.Process(target=behave, args=arguments, daemon=True)
    client.start()
    assert begun.wait(START_S)
    if attack is not None:
        hostile = replace(target, source=ADDRESS)
        attacker = SPAWN.Process(target=repeat, args=(attack, hostile, seconds, attacked))
        attacker.start()
        assert attacked.wait(START_S)
    most_mb, end_s = 0.0, time.monotonic() + seconds
    while time.monotonic() < end_s:
        most_mb = max(most_mb, memory_mb(pid))
        time.sleep(0.05)
    if attacker is not None:
        attacker.kill()
        attacker.join()
    ended.set()
    found = results.get(timeout=60)
    client.join()
    times = quantiles([ms for _, ms in found], n=100)
    answered = sum(good for good, _ in found) / len(found)
    return Figures(len(found), answered, times[49], times[98], most_mb)


def memory_mb(pid: int) -> float:
    """Return the resident memory in MB of the process `pid` and all its descendants."""
    total = 0.0
    for found in (pid, *descendants(pid)):
        with suppress(OSError):
            total += resident_mb(found)
    return total


@contextmanager
def own_service(model: str) -> Iterator[tuple[Target, int]]:
    """Start a service with one worker and a new token; yield its address and its process id."""
    token = secrets.token_hex(16)
    with bind("127.0.0.1", 0) as probe:
        port = probe.getsockname()[1]
    command = [sys.executable, "-m", "serve", "--model", model, "--port", str(port)]
    with tempfile.TemporaryFile() as said:
        process = subprocess.Popen(
            command, env={**os.environ, TOKEN_VARIABLE: token}, stdout=said, stderr=said
        )
        try:
            end_s = time.monotonic() + START_S
            connection = http.client.HTTPConnection("127.0.0.1", port, timeout=10)
            while not ask(connection, token):
                if process.poll() is not None or time.monotonic() > end_s:
                    said.seek(0)
                    raise RuntimeError(f"it does not answer:\n{said.read().decode()[-2000:]}")
                time.sleep(0.2)
            yield Target(port, token), process.pid
            sys.stderr.write(f"lines in its log: {log_lines(said)}\n")
        finally:
            process.terminate()
            process.wait(30)


def log_lines(said: Any) -> int:
    """Return the number of lines in the open file `said`, a log."""
    said.seek(0)
    return int(said.read().count(b"\n"))


@dataclass(frozen=True)
class Asked:
    """Options of a run: the duration of each attack (s), the longest wait after an attack (s), the
    attacks, and whether stdout is for JSON."""

    seconds: float
    settle_s: float
    attacks: list[Attack]
    as_json: bool


def chosen(names: str) -> list[Attack]:
    """Return the attacks whose names are in `names`, separated by commas; all attacks if `names` is
    empty. Raises UserError for an unknown name."""
    wanted = set(names.split(",")) if names else {attack.__name__ for attack in ATTACKS}
    unknown = wanted - {attack.__name__ for attack in ATTACKS}
    if unknown:
        raise UserError(f"there is no attack {', '.join(sorted(unknown))}")
    return [attack for attack in ATTACKS if attack.__name__ in wanted]


def compare(target: Target, pid: int, asked: Asked) -> list[dict[str, Any]]:
    """Measure the service without an attack, then with each attack; return and print the rows."""
    measure(target, pid, 5.0, None)  # fills the caches and pools of the service
    quiet = measure(target, pid, max(QUIET_S, asked.seconds), None)
    rows: list[dict[str, Any]] = [{"attack": "none", **asdict(quiet)}]
    report(rows[0], asked.as_json)
    for attack in asked.attacks:
        under = measure(target, pid, asked.seconds, attack)
        settled_s = settle(pid, quiet.most_mb + LEFT_MB, asked.settle_s)
        row = {"attack": attack.__name__, **asdict(under), "settled_s": settled_s}
        row["slower"] = under.p99_ms / quiet.p99_ms
        row["growth_mb"] = under.most_mb - quiet.most_mb
        row["left_mb"] = memory_mb(pid) - quiet.most_mb
        row["ok"] = (
            under.answered >= ANSWERED
            and row["slower"] <= SLOWER
            and row["growth_mb"] <= GROWTH_MB + BODIES_MB
            and row["left_mb"] <= LEFT_MB
        )
        rows.append(row)
        report(row, asked.as_json)
    return rows


def settle(pid: int, limit_mb: float, at_most_s: float) -> float:
    """Wait until the memory of the service with the process id `pid` is at most `limit_mb`, but at
    most `at_most_s` s. Return the duration of the wait in s."""
    begin = time.monotonic()
    time.sleep(min(SETTLE_S, at_most_s))
    while memory_mb(pid) > limit_mb and time.monotonic() - begin < at_most_s:
        time.sleep(0.5)
    return time.monotonic() - begin


def report(row: dict[str, Any], as_json: bool) -> None:
    """Print one row of the table, to stderr if stdout is for JSON."""
    line = (
        f"{row['attack']:28} {100 * row['answered']:6.2f} % of {row['requests']:4d} answered, "
        f"p50 {row['p50_ms']:6.1f}, p99 {row['p99_ms']:7.1f} ms, {row['most_mb']:6.0f} MB"
    )
    if "ok" in row:
        line += (
            f", p99 x {row['slower']:.2f}, {row['growth_mb']:+.0f} MB, later "
            f"{row['left_mb']:+.0f} MB{'' if row['ok'] else '  MISSED'}"
        )
    print(line, flush=True, file=sys.stderr if as_json else sys.stdout)


def main(
    address: str = "",
    pid: int = 0,
    seconds: float = 60.0,
    settle: float = 60.0,
    only: str = "",
    model: str = "default",
    json: bool = False,
    out: Path | None = None,
) -> None:
    asked = Asked(seconds, settle, chosen(only), json)
    if not address:
        with own_service(model) as (target, process):
            rows = compare(target, process, asked)
    else:
        host, _, port = address.rpartition(":")
        if not is_loopback(host) or not pid:
            raise UserError("give a loopback address, and the --pid of the service there")
        rows = compare(Target(int(port), os.environ.get(TOKEN_VARIABLE)), pid, asked)
    text = dumps(rows, indent=1)
    if json:
        print(text)
    if out is not None:
        out.write_text(text + "\n", encoding="utf-8")
    missed = [row["attack"] for row in rows if not row.get("ok", True)]
    print(f"{len(rows) - 1} attacks, missed: {', '.join(missed) or 'none'}", file=sys.stderr)
    sys.exit(exit_code(not missed))


if __name__ == "__main__":
    run_command(main)
