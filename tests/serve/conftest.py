"""A fake engine, images, and a running service: what the tests of `serve` share."""

import http.client
import json
import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import pytest
import simplejpeg
from numpy.typing import NDArray

import trackfeatures as tf
from mtlnet.inference.engine import Engine
from mtlnet.inference.model_card import WEIGHTS, ModelCard, golden_image
from runtime.sockets import bind
from serve.app import Service
from serve.config import Limits
from serve.server.worker_server import WorkerServer
from serve.workers.shared_memory import SharedMemory, WorkerPeers
from trackfeatures.camera import CameraParameters

if TYPE_CHECKING:
    from opentelemetry.trace import Tracer

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
    doubt=None,
)


class FakeEngine:
    """Answers with `respond(image)`; the real engines have the same attributes."""

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
    """Engine outputs (9,) for these distances (m, NaN absent) and angle (rad)."""
    coded = tf.encode(np.array([distances]), np.array([angle]))[0]
    return np.concatenate([coded, [0.2, 0.5, 0.3]]).astype(np.float32)


def picture(width: int = 280, height: int = 210, channels: int = 3) -> NDArray[np.uint8]:
    """A smooth picture (height, width, channels): a gradient in each channel."""
    x, y = np.meshgrid(np.linspace(0, 200, width), np.linspace(0, 50, height))
    planes = [(x + y * (1 + c)) % 256 for c in range(channels)]
    return np.stack(planes, axis=2).astype(np.uint8)


def jpeg(image: NDArray[np.uint8], colours: str = "RGB") -> bytes:
    subsampling = "444" if colours == "RGB" else "Gray"
    return bytes(simplejpeg.encode_jpeg(np.ascontiguousarray(image), 95, colours, subsampling))


def png(image: NDArray[Any], *options: int) -> bytes:
    """`image` in OpenCV's channel order (BGR, BGRA or grey)."""
    done, data = cv2.imencode(".png", image, list(options))
    assert done
    return data.tobytes()


class Gate:
    """An engine that answers only when `open`; `busy` once it has begun on a frame."""

    def __init__(self) -> None:
        self.open, self.busy = threading.Event(), threading.Event()
        self.engine = FakeEngine(self._respond)

    def _respond(self, _image: NDArray[np.uint8]) -> NDArray[np.float32]:
        self.busy.set()
        assert self.open.wait(20)
        return outputs()


def until(condition: Callable[[], bool]) -> None:
    """Return once `condition` holds; fail after 20 s."""
    end = time.monotonic() + 20
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.002)


@pytest.fixture
def engine() -> FakeEngine:
    return FakeEngine(lambda _image: outputs())


@dataclass(frozen=True)
class Reply:
    """What came back: the status, headers by lower-case name, the body read as JSON."""

    status: int
    headers: dict[str, str]
    content: Any


class Served:
    """A running service, and one connection to it."""

    def __init__(
        self, port: int, app: Service | None = None, listener: socket.socket | None = None
    ) -> None:
        self.port = port
        self._app = app
        self._listener = listener
        self.url = f"http://127.0.0.1:{port}"
        self._connection = http.client.HTTPConnection("127.0.0.1", port, timeout=120)

    @property
    def app(self) -> Service:
        """What runs behind the port, in a thread of this process."""
        assert self._app is not None
        return self._app

    @property
    def listener(self) -> socket.socket:
        """The socket on which this process takes its connections."""
        assert self._listener is not None
        return self._listener

    def ask(
        self, method: str, path: str, body: Any = None, headers: dict[str, str] | None = None
    ) -> Reply:
        self._connection.request(method, path, body, headers or {})
        response = self._connection.getresponse()
        content = response.read()
        found = {name.lower(): value for name, value in response.getheaders()}
        is_json = "json" in found.get("content-type", "")
        return Reply(response.status, found, json.loads(content) if is_json else content)

    def post(self, body: Any, kind: str | None = "image/jpeg", **headers: str) -> Reply:
        sent = {name.replace("_", "-"): value for name, value in headers.items()}
        return self.ask("POST", "/features", body, sent | ({"Content-Type": kind} if kind else {}))


@contextmanager
def serving(
    engine: Engine,
    check: Callable[[Any], object] = lambda _engine: None,
    limits: Limits | None = None,
    shared: SharedMemory | None = None,
    block: int = 0,
    tracer: "Tracer | None" = None,
    beside: Served | None = None,
) -> Iterator[Served]:
    """The service around `engine` on a free port, as `serve` runs it, in a thread of this process.

    Ready when entered, unless `check` takes its time. `beside`: on its port, as another worker.
    """

    def checked(engine: Engine) -> None:
        check(engine)

    listener = beside.listener.dup() if beside is not None else bind("127.0.0.1", 0)
    listener.listen(2048)
    app = Service(engine, checked, limits, shared, block, tracer)
    server = WorkerServer(app, limits or Limits(), WorkerPeers(app.shared, block))
    thread = threading.Thread(target=server.run, kwargs={"sockets": [listener]})
    thread.start()
    try:
        while not server.started:
            assert thread.is_alive()
            time.sleep(0.005)
        yield Served(listener.getsockname()[1], app, listener)
    finally:
        server.should_exit = True
        thread.join()
        listener.close()


@pytest.fixture
def service(engine: FakeEngine) -> Iterator[Served]:
    """The service around `engine`, ready."""
    with serving(engine) as served:
        yield served


@pytest.fixture(scope="session")
def published(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An untrained network, published as `mtlnet train` does, in a folder RUNS/latest links to."""
    runs = tmp_path_factory.mktemp("serve") / "runs"
    publish_untrained(runs / "fresh", seed=3)
    (runs / "latest").symlink_to("fresh")
    return runs / "fresh"


def publish_untrained(run: Path, seed: int) -> None:
    """A whole model in folder `run`; its weights are those of `seed`."""
    import torch

    from mtlnet.export.publish import publish
    from mtlnet.model.network import Network

    torch.manual_seed(seed)
    publish(Network(), run, golden_image(280, 210)[None])
