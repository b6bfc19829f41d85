"""How long `serve` takes from its command to its first "ready": as a user starts it, one worker.

    python benchmarks/service_start.py [--model RUN] [--starts 5] [--json FILE]   claim: under 1 s

Ready is /readyz, asked every 5 ms: the model is loaded, warm and has given its golden answer. The
first start of all is not counted: it reads the programs from the disk. Without --model it is an
untrained network.
"""

import argparse
import http.client
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from statistics import median

sys.path.insert(0, str(Path(__file__).parents[1]))

from runtime.sockets import bind

ROOT = Path(__file__).parents[1]
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
    """Seconds from the command to ready; the service is ended after that."""
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


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--model", type=Path, help="the folder of a run")
    parser.add_argument("--starts", type=int, default=5)
    parser.add_argument("--json", type=Path, help="write the result to this file as well")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        model = options.model
        if model is None:
            from tests.serve.conftest import publish_untrained

            model = Path(folder) / "run"
            publish_untrained(model, seed=3)
        times = [start_s(model) for _ in range(options.starts + 1)][1:]
    result = {
        "start_s": [round(found, 3) for found in times],
        "median_s": round(median(times), 3),
        "claim_below_s": CLAIM_S,
        "reached": median(times) < CLAIM_S,
    }
    print(json.dumps(result))
    if options.json is not None:
        options.json.write_text(json.dumps(result, indent=1) + "\n")
    sys.exit(0 if result["reached"] else 1)


if __name__ == "__main__":
    main()
