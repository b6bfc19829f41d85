"""Shared by the tests of `serve`: a fake engine, images, and a running service.

Tests wait for events, never for a fixed time, and at most `PATIENCE_S`, which is long enough on a
busy machine. Tests of time limits set the service's clock (`Clock`).
"""

import http.client
import json
import socket
import struct
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from numpy.typing import NDArray

import trackfeatures as tf
from mtlnet.inference.engine import Engine
from mtlnet.inference.golden_image import golden_image
from mtlnet.inference.model_card import WEIGHTS, ModelCard
from runtime.sockets import bind
from serve import shared_memory
from serve.app import Service
from serve.cameras import Cameras
from serve.config import Limits
from serve.observability import metrics
from serve.problems import PROBLEM_TYPES
from serve.server import guard
from serve.server.connection import GuardedProtocol
from serve.server.worker_server import WorkerServer
from serve.shared_memory import HEARTBEAT, SharedMemory, WorkerPeers
from tests.mtlnet.inference.images import jpeg as jpeg
from tests.mtlnet.inference.images import picture as picture
from tests.mtlnet.inference.images import png as png
from trackfeatures.camera import CameraParameters

if TYPE_CHECKING:
    from opentelemetry.trace import Tracer

PATIENCE_S = 120.0  # the longest wait for an event

CARD = ModelCard(
    name="fake",
    definitions_version=tf.VERSION,
    program_version="0",
    camera=CameraParameters(),
    alpha=(0.3, 0.2, 0.5),
    network="mtl",
    recipe="fast",
    iterations=1,
    batch=1,
    seed=0,
    data={},
    versions={},
    files={WEIGHTS: "ab" * 32},
    export_check={},
    golden=tuple([0.5] * 6 + [0.2, 0.5, 0.3]),
    uncertainty=None,
)


class FakeEngine:
    """An engine that returns `respond(image)`; it has the attributes of the real engines."""

    card = CARD
    kind = "fake"
    precision = "f32"

    def __init__(self, respond: Callable[[NDArray[np.uint8]], NDArray[np.float32]]) -> None:
        self.respond = respond
        self.images: list[NDArray[np.uint8]] = []

    def __call__(self, image: NDArray[np.uint8]) -> NDArray[np.float32]:
        self.images.append(image)
        return self.respond(image)


def outputs(
    distances: tuple[float, ...] = (-2.0, 2.0, np.nan, np.nan, np.nan), angle: float = 0.1
) -> NDArray[np.float32]:
    """Engine outputs (9,) for these distances (m, NaN if absent) and this angle (rad)."""
    coded = tf.encode(np.array([distances]), np.array([angle]))[0]
    return np.concatenate([coded, [0.2, 0.5, 0.3]]).astype(np.float32)


JPEG, PNG = jpeg(picture()), png(picture())
HEAD = b"POST /features HTTP/1.1\r\nHost: localhost\r\nContent-Type: image/jpeg\r\n"
WHOLE = HEAD + b"Content-Length: %d\r\n\r\n" % len(JPEG) + JPEG
INFER = "/v2/models/track/infer"


def tensor_request(image: bytes, **more: Any) -> tuple[dict[str, str], bytes]:
    """The header and the body of an inference request with an image file as binary data."""
    raw = struct.pack("<I", len(image)) + image
    tensor = {"name": "image", "shape": [1, 1], "datatype": "BYTES"}
    size = {"parameters": {"binary_data_size": len(raw)}}
    head = json.dumps({"inputs": [{**tensor, **size}], **more}).encode()
    return {"Inference-Header-Content-Length": str(len(head))}, head + raw


def constant_engine() -> FakeEngine:
    """An engine with the same outputs for every image."""
    return FakeEngine(lambda _image: outputs())


class Gate:
    """An engine that answers only after `open` is set; it sets `busy` when it begins a frame."""

    def __init__(self) -> None:
        self.open, self.busy = threading.Event(), threading.Event()
        self.engine = FakeEngine(self._respond)

    def _respond(self, _image: NDArray[np.uint8]) -> NDArray[np.float32]:
        self.busy.set()
        assert self.open.wait(PATIENCE_S)
        return outputs()


def until(condition: Callable[[], bool]) -> None:
    """Return once `condition` holds; fail after PATIENCE_S."""
    end = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.002)


class Clock:
    """A clock in s that only the test advances."""

    def __init__(self) -> None:
        self.now_s = 1000.0

    def __call__(self) -> float:
        return self.now_s

    def advance(self, seconds: float) -> None:
        self.now_s += seconds


@pytest.fixture(autouse=True)
def patient_service(monkeypatch: pytest.MonkeyPatch) -> None:
    """Lengthen timeouts, so that in a slow test no worker counts as dead and no problem is lost."""
    monkeypatch.setattr(guard, "LINGER_S", PATIENCE_S)
    for reader in (shared_memory, metrics):
        monkeypatch.setattr(reader, "HEARTBEAT_TIMEOUT_S", PATIENCE_S)


@pytest.fixture
def engine() -> FakeEngine:
    return constant_engine()


@dataclass(frozen=True)
class Reply:
    """A reply: its status, its headers by lower-case name, its body decoded from JSON."""

    status: int
    headers: dict[str, str]
    content: Any


def assert_problem(reply: Reply, status: int, name: str) -> None:
    assert reply.status == status
    assert reply.headers["content-type"] == "application/problem+json"
    content = reply.content
    hint = {"retry_after_ms"} if status in (429, 503) else set()
    assert set(content) - {"error"} == {"type", "title", "status", "detail"} | hint
    assert content.get("error", content["detail"]) == content["detail"]
    assert content["type"] == f"/problems/{name}"
    assert content["status"] == status
    assert content["title"] == next(k.title for k in PROBLEM_TYPES if k.name == name)
    assert len(content["detail"]) > 20
    assert "Traceback" not in content["detail"]


class Served:
    """A running service, with one connection to it."""

    def __init__(
        self, port: int, server: WorkerServer | None = None, listener: socket.socket | None = None
    ) -> None:
        self.port = port
        self._server = server
        self._listener = listener
        self.url = f"http://127.0.0.1:{port}"
        self._connection = http.client.HTTPConnection("127.0.0.1", port, timeout=PATIENCE_S)

    @property
    def server(self) -> WorkerServer:
        """The server, which runs in a thread of this process."""
        assert self._server is not None
        return self._server

    @property
    def app(self) -> Service:
        """The application of this server."""
        return self.server.app

    def close(self) -> None:
        """Close the connection; the next request opens a new one."""
        self._connection.close()

    def received_bytes(self) -> list[int]:
        """The number of received bytes of each incomplete request, in ascending order."""
        receiving = list(self.server.guard.receiving)
        return sorted(f._unread_bytes for f in receiving if isinstance(f, GuardedProtocol))

    @property
    def listener(self) -> socket.socket:
        """The socket on which the service listens."""
        assert self._listener is not None
        return self._listener

    def wait_received(self, *counts: int) -> None:
        """Wait until the incomplete requests have received exactly these numbers of bytes."""
        until(lambda: self.received_bytes() == sorted(counts))

    def wait_for_tick(self) -> None:
        """Wait until the server has checked for expired connections again."""
        cells = self.app.shared.worker(0)
        for _ in range(2):  # the first check can have begun before this call
            last = cells[HEARTBEAT]
            until(partial(lambda last: cells[HEARTBEAT] != last, last))

    def ask(
        self, method: str, path: str, body: Any = None, headers: dict[str, str] | None = None
    ) -> Reply:
        self._connection.request(method, path, body, headers or {})
        response = self._connection.getresponse()
        content = response.read()
        found = {name.lower(): value for name, value in response.getheaders()}
        is_json = "json" in found.get("content-type", "")
        return Reply(response.status, found, json.loads(content or b"null") if is_json else content)

    def post(self, body: Any, kind: str | None = "image/jpeg", **headers: str) -> Reply:
        sent = {name.replace("_", "-"): value for name, value in headers.items()}
        return self.ask("POST", "/features", body, sent | ({"Content-Type": kind} if kind else {}))


@contextmanager
def serving(
    engine: Engine | None = None,
    check: Callable[[Any], Any] | None = None,
    limits: Limits | None = None,
    shared: SharedMemory | None = None,
    block: int = 0,
    tracer: "Tracer | None" = None,
    beside: Served | None = None,
    clock: Callable[[], float] | None = None,
    host: str = "127.0.0.1",
    cameras: Cameras | None = None,
) -> Iterator[Served]:
    """The service with `engine` on a free port, as `serve` runs it, in a thread of this process.

    Without `engine` it has a `constant_engine`. It is ready on entry unless `check` is given. With
    `beside` it is another worker on the port of that service. `clock` in s is for the deadlines of
    its connections. `host` is the address to listen on, `cameras` the named cameras.
    """

    listener = beside.listener.dup() if beside is not None else bind(host, 0)
    listener.listen(2048)
    parts = (limits, shared, block, tracer, cameras or {})
    app = Service(engine or constant_engine(), check or (lambda _engine: None), *parts)
    server = WorkerServer(app, limits or Limits(), WorkerPeers(app.shared, block))
    if clock is not None:
        server.guard.clock = clock
    thread = threading.Thread(target=server.run, kwargs={"sockets": [listener]})
    thread.start()
    served = Served(listener.getsockname()[1], server, listener)
    try:
        until(lambda: server.started or not thread.is_alive())
        assert server.started
        if check is None:
            until(lambda: app.frame_queue.ready)
        yield served
    finally:
        served.close()  # the server would wait for another request on this connection
        server.should_exit = True
        thread.join()
        listener.close()


@contextmanager
def busy(**options: Any) -> Iterator[tuple[Served, Gate]]:
    """A service, made with `options`, whose engine works on an image until its gate is opened."""
    gate = Gate()
    with serving(gate.engine, **options) as served, ThreadPoolExecutor(1) as pool:
        first = pool.submit(Served(served.port).post, JPEG)
        assert gate.busy.wait(PATIENCE_S)
        yield served, gate
        gate.open.set()
        assert first.result().status == 200


@pytest.fixture
def service(engine: FakeEngine) -> Iterator[Served]:
    """The ready service with `engine`."""
    with serving(engine) as served:
        yield served


@pytest.fixture(scope="session")
def published(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The run of an untrained network, published as by `mtlnet train`; RUNS/latest links to it."""
    runs = tmp_path_factory.mktemp("serve") / "runs"
    publish_untrained(runs / "fresh", seed=3)
    (runs / "latest").symlink_to("fresh")
    return runs / "fresh"


def publish_untrained(run: Path, seed: int) -> None:
    """Write a complete model with random weights of this `seed` to the folder `run`."""
    import torch

    from mtlnet.export.publish import publish
    from mtlnet.model.network import Network

    torch.manual_seed(seed)
    publish(Network(), run, golden_image(280, 210)[None])
