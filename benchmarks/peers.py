"""The service compared with LitServe, BentoML and mosec: time of a request, and throughput.

All servers have the same weights on OpenVINO in the same precision, with an engine of one thread
per worker. They receive the same JPEG by POST and answer with the same JSON. Each peer is set up as
its own manual advises (`service_load/peer_*.py`).
Time of a request: all servers run at once with one worker each and get requests in turns over one
connection. Throughput: the servers run one after another with two workers each, in several turns;
eight clients send their next request as soon as they have an answer. Each peer needs a Python
environment with the peer, openvino, numpy and simplejpeg. A peer that is not given is skipped.

    python benchmarks/peers.py --litserve PYTHON --bentoml PYTHON --mosec PYTHON
        [--model RUN] [--int8] [--requests 2000] [--seconds 10] [--turns 3] [--out FILE]
    claims: our p50 is at most 0.75 (LitServe), 0.65 (BentoML), 1.0 (mosec) of the peer's p50; our
    throughput is at least 1.5 (LitServe), 1.8 (BentoML), 1.0 (mosec) times the peer's throughput
"""

import sys
import tempfile
from contextlib import ExitStack
from pathlib import Path
from statistics import median
from time import perf_counter
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1]))

from benchmarks.claims.outcome import conclude, not_measured, run_command
from benchmarks.service import TURN, connect, exchange
from benchmarks.service_load.servers import (
    OURS,
    PEERS,
    ComparisonOptions,
    Loader,
    model_copy,
    request,
    running,
)
from runtime.options import options_of

CLAIMS = {"litserve": (0.75, 1.5), "bentoml": (0.65, 1.8), "mosec": (1.0, 1.0)}
"""For each peer the upper limit of our p50 divided by the peer's p50, and the lower limit of our
throughput divided by the peer's throughput."""
CLIENTS, WORKERS = 8, 2


def latency(servers: dict[str, Path], run: Path, requests: int) -> dict[str, list[float]]:
    """Return the times in ms of `requests` requests to each server. The servers get TURN requests
    each in turns. `servers` has the Python interpreter of each server, `run` the model."""
    found: dict[str, list[float]] = {name: [] for name in servers}
    with ExitStack() as stack:
        ports = {
            name: stack.enter_context(running(name, python, run, 1))
            for name, python in servers.items()
        }
        for _ in range(max(1, requests // TURN)):
            for name, port in ports.items():
                found[name] += ask(port, TURN)
    return found


def ask(port: int, count: int) -> list[float]:
    """Send `count` requests over a new connection, after one request that is not counted. Return
    their times in ms."""
    sent, times = request(), []
    with connect(("127.0.0.1", port)) as connection:
        exchange(connection, sent)
        for _ in range(count):
            start = perf_counter()
            exchange(connection, sent)
            times.append(1e3 * (perf_counter() - start))
    return times


def throughput(servers: dict[str, Path], run: Path, seconds: float, turns: int) -> dict[str, Any]:
    """Return the answers per second of each server and the p99 of their times in ms. Each figure is
    the median over the turns; a turn takes `seconds`."""
    found: dict[str, list[tuple[float, float]]] = {name: [] for name in servers}
    with tempfile.TemporaryDirectory() as folder:
        loader = Loader(Path(folder))
        for _ in range(turns):
            for name, python in servers.items():
                with running(name, python, run, WORKERS) as port:
                    loader.run(port, CLIENTS, 1.0)
                    load = loader.run(port, CLIENTS, seconds)
                found[name].append((load.per_second(), load.percentile(99)))
    return {
        name: {"per_second": median(a for a, _ in rows), "p99_ms": median(b for _, b in rows)}
        for name, rows in found.items()
    }


def compare(name: str, ours: dict[str, Any], theirs: dict[str, Any]) -> dict[str, Any]:
    """Return our p50 and throughput divided by the p50 and throughput of the peer `name`, the
    limits of both ratios, and whether the limits are kept."""
    p50, rate = ours["p50_ms"] / theirs["p50_ms"], ours["per_second"] / theirs["per_second"]
    slowest, fewest = CLAIMS[name]
    held = p50 <= slowest and rate >= fewest
    return {"our_ratios": [p50, rate], "claims": [slowest, fewest], "held": held}


@options_of(ComparisonOptions)
def main(
    options: ComparisonOptions,
    requests: int = 2_000,
    seconds: float = 10.0,
    turns: int = 3,
    out: Path | None = None,
) -> None:
    servers = options.pythons()
    if list(servers) == [OURS]:
        not_measured("give at least one peer, e.g. --litserve PYTHON")
    with model_copy(options.model, options.int8) as folder:
        times = latency(servers, folder, requests)
        rates = throughput(servers, folder, seconds, turns)
    figures = {name: {"p50_ms": median(times[name]), **rates[name]} for name in servers}
    for name in figures.keys() - {OURS}:
        figures[name] |= compare(name, figures[OURS], figures[name])
    skipped = [name for name in PEERS if name not in servers]
    held = all(each.get("held", True) for each in figures.values())
    conclude({"servers": figures, "skipped": skipped}, out, held)


if __name__ == "__main__":
    run_command(main)
