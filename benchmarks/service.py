"""Overhead of the service: our POST /features compared with a plain FastAPI handler.

Both handlers get the same JPEG, decode it in the same way and use the same engine, which does
nothing. The plain handler has no limits, queue, thread, streams or metrics. The overhead is the
time of a request at the client minus the decoding and inference time that the server measures. Each
server is a separate process. The client sends requests to them in turns, each over one connection,
so that other load on the machine affects both equally. The result also has the processor time per
request, which other load affects least.

    python benchmarks/service.py [--quick] [--out FILE]
    claim: our overhead is at most 0.75 of the plain handler's overhead
"""

import json
import socket
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from statistics import median, quantiles
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1]))

from benchmarks.claims.outcome import conclude, run_command
from benchmarks.service_load.servers import processor_s
from tests.serve.conftest import FakeEngine, jpeg, outputs, picture

CLAIM = 0.75
TURN = 50  # number of requests to one server before the next server's turn


def plain(engine: FakeEngine) -> Any:
    """Return a FastAPI app whose POST /features decodes the image, predicts by `engine` and
    answers. It does nothing else."""
    from fastapi import FastAPI, Request

    from mtlnet.inference.image_decoding.decode import crop_and_resize, decode_whole, read_header
    from mtlnet.inference.prediction import decode_outputs

    app = FastAPI()
    camera = engine.card.camera

    @app.post("/features")
    async def features(request: Request) -> dict[str, Any]:
        body = await request.body()
        header = read_header(body)  # before the clock starts, as in the service
        start = time.perf_counter()
        answer = decode_outputs(engine(crop_and_resize(decode_whole(body, header), camera)))
        work_ms = 1e3 * (time.perf_counter() - start)
        timing = {"decode": work_ms, "forward": 0.0}
        return {**answer.as_json(), "model": engine.card.model_hash, "timing_ms": timing}

    return app


def serve(which: str, fd: int) -> None:
    """Serve on the inherited listening socket `fd`: the plain handler if `which` is "plain"."""
    import uvicorn

    engine = FakeEngine(lambda _image: outputs())
    engine.images = Forgetful()
    listener = socket.socket(fileno=fd)
    if which == "plain":
        config = uvicorn.Config(
            plain(engine), loop="uvloop", http="httptools", log_level="error", access_log=False
        )
        uvicorn.Server(config).run(sockets=[listener])
    else:
        from serve.app import Service
        from serve.config import Limits
        from serve.server.worker_server import WorkerServer

        WorkerServer(Service(engine, lambda _engine: None), Limits()).run(sockets=[listener])


class Forgetful(list[Any]):
    """A list that stores nothing. The fake engine appends each image to a list. In the long run of
    this benchmark the images would fill the memory."""

    def append(self, _item: Any) -> None:
        pass


@dataclass(frozen=True)
class Asked:
    """Times of requests in ms: `total` at the client, and `work` (decoding and inference)."""

    total: list[float]
    work: list[float]

    def figures(self) -> dict[str, float]:
        overhead = [total - work for total, work in zip(self.total, self.work, strict=True)]
        return {
            "overhead_ms_p50": median(overhead),
            "total_ms_p50": median(self.total),
            "total_ms_p99": quantiles(self.total, n=100)[98],
        }


def connect(address: tuple[str, int]) -> socket.socket:
    """Open a TCP connection that sends small packets at once (TCP_NODELAY)."""
    connection = socket.create_connection(address)
    connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    return connection


def exchange(connection: socket.socket, request: bytes) -> bytes:
    """Send a whole HTTP request and return the body of the answer. The function itself takes little
    processor time.

    Raises RuntimeError if the status is not 200, ConnectionError if the server closes.
    """
    connection.sendall(request)
    received = b""
    while b"\r\n\r\n" not in received:
        received += _receive(connection)
    head, _, content = received.partition(b"\r\n\r\n")
    fields = dict(line.lower().split(b": ", 1) for line in head.split(b"\r\n")[1:])
    while len(content) < int(fields[b"content-length"]):
        content += _receive(connection)
    if not head.startswith(b"HTTP/1.1 200"):
        raise RuntimeError(content.decode())
    return content


def _receive(connection: socket.socket) -> bytes:
    part = connection.recv(65536)
    if not part:
        raise ConnectionError("the server ended the connection")
    return part


class Asker:
    """Sends the same POST /features again and again over one connection and times it."""

    def __init__(self, address: tuple[str, int], body: bytes) -> None:
        self._socket = connect(address)
        head = (
            "POST /features HTTP/1.1\r\nHost: localhost\r\nContent-Type: image/jpeg\r\n"
            f"Content-Length: {len(body)}\r\n\r\n"
        )
        self._request = head.encode() + body

    def ask(self) -> tuple[float, float]:
        """Send one request. Return its time in ms, and the part of this time in ms that the server
        spent with decoding and inference."""
        start = time.perf_counter()
        content = exchange(self._socket, self._request)
        total_ms = 1e3 * (time.perf_counter() - start)
        timing = json.loads(content)["timing_ms"]
        return total_ms, timing["decode"] + timing["forward"]


def measure(requests: int) -> dict[str, Any]:
    """Send `requests` requests to each of the two servers in turns. Return the figures of both
    servers, and the ratio of their overheads."""
    body = jpeg(picture())
    found = {name: Asked([], []) for name in ("driverview", "plain")}
    processes, askers = [], {}
    for name in found:
        listener = socket.create_server(("127.0.0.1", 0))
        command = [sys.executable, __file__, "--which", name]
        command += ["--descriptor", str(listener.fileno())]
        processes.append(subprocess.Popen(command, pass_fds=(listener.fileno(),)))
        askers[name] = Asker(listener.getsockname(), body)  # connects: the socket already listens
        listener.close()
    try:
        for asker in askers.values():
            for _ in range(TURN):
                asker.ask()
        before = [processor_s([process.pid]) for process in processes]
        for _ in range(requests // TURN):
            for name, asked in found.items():
                for _ in range(TURN):
                    total, work = askers[name].ask()
                    asked.total.append(total)
                    asked.work.append(work)
        spent = [
            1e3 * (processor_s([process.pid]) - start)
            for process, start in zip(processes, before, strict=True)
        ]
    finally:
        for process in processes:
            process.kill()
            process.wait()
    figures: dict[str, Any] = {name: asked.figures() for name, asked in found.items()}
    for name, spent_ms in zip(found, spent, strict=True):
        figures[name]["cpu_ms_mean"] = spent_ms / requests
        figures[name]["overhead_cpu_ms"] = spent_ms / requests - median(found[name].work)
    ratio = figures["driverview"]["overhead_ms_p50"] / figures["plain"]["overhead_ms_p50"]
    return {**figures, "requests": requests, "overhead_ratio": ratio, "claim": CLAIM}


def main(
    quick: bool = False, out: Path | None = None, which: str = "", descriptor: int = 0
) -> None:
    if which:
        serve(which, descriptor)
        return
    result = measure(1_000 if quick else 10_000)
    conclude(result, out, result["overhead_ratio"] <= CLAIM)


if __name__ == "__main__":
    run_command(main)
