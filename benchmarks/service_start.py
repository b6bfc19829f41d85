"""Measures the time from the command `serve` until the service is ready, with one worker.

    python benchmarks/service_start.py [--model RUN] [--starts 5] [--json FILE]
    claim: less than 1 s

The service is ready when /readyz, which is requested every 5 ms, answers 200. The model is then
loaded and warm, and has passed its check. The first start is not counted, because it reads the
programs from the disk.
Without --model the network is untrained.
"""

import http.client
import os
import subprocess
import sys
import time
from pathlib import Path
from statistics import median

sys.path.insert(0, str(Path(__file__).parents[1]))

from benchmarks.claims.outcome import conclude, run_command
from benchmarks.service_load.servers import ROOT, model_copy
from runtime.sockets import bind

CLAIM_S = 1.0
GIVE_UP_S = 120.0


def is_ready(port: int) -> bool:
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=5)
    try:
        connection.request("GET", "/readyz")
        return connection.getresponse().status == 200
    except OSError:
        return False
    finally:
        connection.close()


def start_s(model: Path) -> float:
    """Start the service, wait until it is ready, and end it; return the seconds until ready."""
    with bind("127.0.0.1", 0) as free:
        port = free.getsockname()[1]
    words = [sys.executable, "-m", "serve", "--model", str(model), "--port", str(port)]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    begin = time.perf_counter()
    with subprocess.Popen(words, stderr=subprocess.PIPE, env=environment) as process:
        try:
            while not is_ready(port):
                if process.poll() is not None or time.perf_counter() - begin > GIVE_UP_S:
                    raise RuntimeError("the service did not become ready")
                time.sleep(0.005)
            return time.perf_counter() - begin
        finally:
            process.terminate()


def main(model: Path | None = None, starts: int = 5, json: Path | None = None) -> None:
    with model_copy(model, int8=True) as folder:
        times = [start_s(folder) for _ in range(starts + 1)][1:]
    result = {
        "start_s": [round(found, 3) for found in times],
        "median_s": round(median(times), 3),
        "claim_below_s": CLAIM_S,
        "reached": median(times) < CLAIM_S,
    }
    conclude(result, json, median(times) < CLAIM_S)


if __name__ == "__main__":
    run_command(main)
