"""Measures the service under five times the load that it can answer, and with 1,000 slow
connections.

One worker runs on one core and a compiled load generator on another core. The loads are: one client
alone; as many clients as keep the engine busy (the peak); frames at five times the peak rate, sent
without waiting for answers; four clients at a fifth of the peak rate, without and with 1,000 other
connections whose requests never end. Each given peer is measured in the same way.

    python benchmarks/overload.py [--litserve PYTHON] [--bentoml PYTHON] [--mosec PYTHON]
        [--model RUN] [--int8] [--seconds 30] [--out FILE]
    claims for our service: the p99 of admitted frames is at most twice the p99 of one client alone
    plus the time of a full queue; at least 0.95 of the peak rate is answered; the p99 of refusals
    is at most 5 ms; slow connections at most double the p99 of the four clients, and none of the
    clients' requests fails
"""

import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1]))

from benchmarks.claims.outcome import conclude, run_command
from benchmarks.service_load.servers import (
    HERE,
    OURS,
    ComparisonOptions,
    Loader,
    model_copy,
    running,
)
from runtime.options import options_of
from serve.config import Limits

OVER, GOODPUT, REFUSED_MS, SLOWER = 5.0, 0.95, 5.0, 2.0
BUSY = 4  # number of clients that keep one worker busy; its queue has room for their frames
CONNECTIONS = 64  # number of connections of the load generator under overload
SLOW = 1000  # number of slow connections
SETTLE_S = 3.0  # time in which the slow connections are opened
SERVER, CLIENTS = {0}, {1}  # cores of the service and of its clients


def overload(loader: Loader, port: int, seconds: float) -> dict[str, Any]:
    """Load the service with one client, at its peak rate, and at five times its peak rate, each for
    `seconds`. Return the rates per second and the times in ms."""
    loader.run(port, 1, 1.0)
    alone = loader.run(port, 1, seconds)
    peak = loader.run(port, BUSY, seconds).per_second()
    over = loader.run(port, CONNECTIONS, seconds, OVER * peak)
    return {
        "alone_p99_ms": alone.percentile(99),
        "peak_per_second": peak,
        "offered_per_second": OVER * peak,
        "answered_per_second": over.per_second(),
        "refused_per_second": over.per_second(503),
        "broken_per_second": over.per_second(0),
        "admitted_p50_ms": over.percentile(50),
        "admitted_p99_ms": over.percentile(99),
        "refused_p50_ms": over.percentile(50, 503),
        "refused_p99_ms": over.percentile(99, 503),
    }


def beside_slow_ones(loader: Loader, port: int, seconds: float, rate: float) -> dict[str, Any]:
    """Load the service for `seconds` with four clients that together send `rate` requests per
    second, without slow connections and then with them. Return both p99 in ms, and the number of
    requests that were not answered while there were slow connections."""
    before = loader.run(port, BUSY, seconds, rate)
    with crowd(port):
        beside = loader.run(port, BUSY, seconds, rate)
    return {
        "p99_ms": before.percentile(99),
        "p99_ms_beside_slow": beside.percentile(99),
        "not_answered_beside_slow": int((beside.status != 200).sum()),
    }


@contextmanager
def crowd(port: int) -> Iterator[None]:
    """Hold SLOW slow connections to the service at `port` open while the context lasts."""
    process = subprocess.Popen(
        [sys.executable, str(HERE / "slow_clients.py"), str(port), str(SLOW)],
        preexec_fn=lambda: os.sched_setaffinity(0, CLIENTS),
    )
    try:
        time.sleep(SETTLE_S)
        yield
    finally:
        process.kill()
        process.wait()


def judge(found: dict[str, Any]) -> dict[str, bool]:
    """Return for each claim, by name, whether it holds for `found`, the figures of our service."""
    queue_ms = Limits().queue * 1e3 / found["peak_per_second"]
    return {
        "admitted": found["admitted_p99_ms"] <= 2 * found["alone_p99_ms"] + queue_ms,
        "goodput": found["answered_per_second"] >= GOODPUT * found["peak_per_second"],
        "refusals": found["refused_p99_ms"] <= REFUSED_MS,
        "slow": found["p99_ms_beside_slow"] <= SLOWER * found["p99_ms"]
        and found["not_answered_beside_slow"] == 0,
    }


@options_of(ComparisonOptions)
def main(options: ComparisonOptions, seconds: float = 30.0, out: Path | None = None) -> None:
    result: dict[str, Any] = {}
    with (
        model_copy(options.model, options.int8) as folder,
        tempfile.TemporaryDirectory() as temporary,
    ):
        loader = Loader(Path(temporary), CLIENTS)
        for name, python in options.pythons().items():
            with running(name, python, folder, 1, SERVER) as port:
                found = overload(loader, port, seconds)
                rate = found["peak_per_second"] / 5
                found |= beside_slow_ones(loader, port, seconds, rate)
            result[name] = found
    result[OURS]["held"] = judge(result[OURS])
    conclude(result, out, all(result[OURS]["held"].values()))


if __name__ == "__main__":
    run_command(main)
