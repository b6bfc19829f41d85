"""Starts the service and its peers as processes, and puts load on them, for several benchmarks.

A peer runs in a separate Python environment with the peer, openvino, numpy and simplejpeg.
"""

import http.client
import os
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from typer import Option

from benchmarks.service_load.peer_work import MODEL, PORT, WORKERS
from tests.serve.conftest import jpeg, picture, publish_untrained

HERE = Path(__file__).parent
ROOT = HERE.parents[1]
OURS = "driverview"
PEERS = ("litserve", "bentoml", "mosec")
START_S, END_S = 120.0, 10.0
BODY = jpeg(picture())


def request(path: str = "/features") -> bytes:
    """Return the bytes of a POST request to `path` with a JPEG of the model's own camera."""
    head = f"POST {path} HTTP/1.1\r\nHost: localhost\r\nContent-Type: image/jpeg\r\n"
    return f"{head}Content-Length: {len(BODY)}\r\n\r\n".encode() + BODY


@dataclass(frozen=True)
class ComparisonOptions:
    """Options of a benchmark that compares the service with PEERS: interpreters and model."""

    litserve: Annotated[Path | None, Option(help="Python of an environment with LitServe.")] = None
    bentoml: Annotated[Path | None, Option(help="Python of an environment with BentoML.")] = None
    mosec: Annotated[Path | None, Option(help="Python of an environment with mosec.")] = None
    model: Annotated[Path | None, Option(help="Folder of a run.", show_default="untrained")] = None
    int8: Annotated[bool, Option("--int8", help="Serve the int8 graph of the run.")] = False

    def pythons(self) -> dict[str, Path]:
        """Return the Python interpreter of each server, by name: first of our service, then of the
        given peers in the order of PEERS."""
        given = {name: getattr(self, name) for name in PEERS if getattr(self, name)}
        return {OURS: Path(sys.executable), **given}


@contextmanager
def model_copy(run: Path | None, int8: bool = False) -> Iterator[Path]:
    """Yield a temporary copy of the model in `run`, or of untrained weights if `run` is None.

    The copy has the int8 graph of `run` only if `int8` is true.
    """
    with tempfile.TemporaryDirectory() as folder:
        found = Path(folder) / "run"
        if run is None:
            publish_untrained(found, seed=3)
        else:
            shutil.copytree(run, found, ignore=None if int8 else shutil.ignore_patterns("export"))
        yield found


def _command(name: str, python: Path, port: int, workers: int, run: Path) -> list[str]:
    if name == OURS:
        options = ["--model", str(run), "--port", str(port), "--workers", str(workers)]
        return [str(python), "-m", "serve", *options]
    if name == "bentoml":
        target = ["serve", "benchmarks.service_load.peer_bentoml:Features"]
        options = ["--host", "127.0.0.1", "--port", str(port)]
        return [str(python.parent / "bentoml"), *target, *options]
    return [str(python), str(HERE / f"peer_{name}.py")]


@contextmanager
def running(
    name: str,
    python: Path,
    run: Path,
    workers: int,
    cores: set[int] | None = None,
    root: Path = ROOT,
) -> Iterator[int]:
    """Start the server `name`, wait until it answers, and yield its port. The server is ended when
    the context ends.

    `cores`: the cores that the server runs on; `root`: its source tree. After this call SIGTERM
    ends this process with SystemExit, so that the server is ended too. Raises RuntimeError if the
    server does not answer.
    """
    signal.signal(signal.SIGTERM, lambda number, _frame: sys.exit(128 + number))
    with socket.create_server(("127.0.0.1", 0)) as probe:
        port = probe.getsockname()[1]
    settings = {MODEL: str(run), WORKERS: str(workers), PORT: str(port)}
    environment = {
        **os.environ,
        **settings,
        "PYTHONPATH": str(root),
        "BENTOML_DO_NOT_TRACK": "True",
    }
    with tempfile.TemporaryFile() as said:
        process = subprocess.Popen(
            _command(name, python, port, workers, run),
            env=environment,
            cwd=root,
            stdout=said,
            stderr=said,
            start_new_session=True,
            preexec_fn=None if cores is None else lambda: os.sched_setaffinity(0, cores),
        )
        try:
            if not _answers(port, process):
                said.seek(0)
                raise RuntimeError(f"{name} does not answer:\n{said.read().decode()[-2000:]}")
            yield port
        finally:
            _end(process)


def _end(process: "subprocess.Popen[bytes]") -> None:
    """End a server with SIGTERM, or with SIGKILL if it still runs after END_S, and kill all its
    descendants."""
    family = descendants(process.pid)
    process.terminate()
    with suppress(subprocess.TimeoutExpired):
        process.wait(END_S)
    for pid in (process.pid, *family):
        with suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)
    process.wait()


def processor_s(pids: list[int]) -> float:
    """Return the processor time in s that the processes with the ids `pids` have used so far,
    summed over them."""
    stats = [Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split() for pid in pids]
    ticks = sum(int(fields[11]) + int(fields[12]) for fields in stats)
    return ticks / os.sysconf("SC_CLK_TCK")


def descendants(pid: int) -> list[int]:
    """Return the ids of all descendants of the process `pid`. (The children that threads other than
    the first thread started are not found.)"""
    try:
        children = Path(f"/proc/{pid}/task/{pid}/children").read_text().split()
    except OSError:  # the process has ended
        return []
    return [found for child in map(int, children) for found in (child, *descendants(child))]


def _answers(port: int, process: "subprocess.Popen[bytes]") -> bool:
    end = time.monotonic() + START_S
    while time.monotonic() < end and process.poll() is None:
        connection = http.client.HTTPConnection("127.0.0.1", port, timeout=10)
        try:
            connection.request("POST", "/features", BODY, {"Content-Type": "image/jpeg"})
            if connection.getresponse().status == 200:
                return True
        except OSError:
            pass
        finally:
            connection.close()
        time.sleep(0.1)
    return False


@dataclass(frozen=True)
class Load:
    """The N requests of a load, as arrays (N,): the times (s) at which they were due, the times
    (ms) that they took, and their HTTP status (0: the connection failed).

    `seconds`: duration of the load.
    """

    due_s: NDArray[np.float64]
    time_ms: NDArray[np.float64]
    status: NDArray[np.int64]
    seconds: float

    def per_second(self, status: int = 200) -> float:
        """Return the number of answers with the status `status` per second."""
        return float((self.status == status).sum()) / self.seconds

    def percentile(self, percent: float, status: int = 200) -> float:
        """Return a percentile of the times in ms of the requests with the status `status`; NaN if
        there are no such requests."""
        times = self.time_ms[self.status == status]
        return float(np.percentile(times, percent)) if len(times) else float("nan")


class Loader:
    """The compiled load generator."""

    def __init__(self, folder: Path, cores: set[int] | None = None) -> None:
        """Compile the load generator into `folder`. `cores`: the cores that it will run on."""
        self._program = folder / "load"
        self._request = folder / "request"
        self._request.write_bytes(request())
        self._cores = cores
        compiler = ["cc", "-O2", "-o", str(self._program), str(HERE / "load.c")]
        subprocess.run(compiler, check=True)

    def run(self, port: int, connections: int, seconds: float, rate: float = 0.0) -> Load:
        """Send requests for `seconds` over `connections` connections, `rate` requests per second in
        total.

        With rate 0 each connection sends its next request when the last answer has arrived.
        """
        numbers = [str(port), str(connections), str(seconds), str(rate)]
        done = subprocess.run(
            [str(self._program), *numbers, str(self._request)],
            check=True,
            capture_output=True,
            text=True,
            preexec_fn=None if self._cores is None else self._pin,
        )
        rows = np.array(done.stdout.split(), np.float64).reshape(-1, 3)
        return Load(rows[:, 0], rows[:, 1], rows[:, 2].astype(np.int64), seconds)

    def _pin(self) -> None:
        assert self._cores is not None
        os.sched_setaffinity(0, self._cores)
