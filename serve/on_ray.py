"""The service as a Ray Serve application (the extra `rayserve`); each replica has one engine.

    serve ray --model runs/latest --replicas 2 --port 8000

This command runs the service on the cluster at $RAY_ADDRESS, or on a new local cluster, until
Ctrl-C. `build` is the application builder for Ray's own commands `serve run` and `serve deploy` and
for its configuration files (`import_path: serve.on_ray:build`, `args: {model: /runs/latest}`).

Ray handles restarts, scaling and the port. So streams and rate limits apply to each replica
separately, and Ray's proxies set the limits for slow clients.
"""

import os
import signal
import sys
import threading
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ray import serve as ray_serve  # not to be confused with this package, `serve`

from mtlnet.inference.engine import load_engine
from mtlnet.inference.model_card import read_card, resolve_run
from mtlnet.inference.view_average import check_count
from runtime.access import read_token
from runtime.cli import counted
from runtime.sockets import url
from serve.app import Service
from serve.cameras import Cameras, read_cameras
from serve.config import Limits, ServiceConfig
from serve.observability import telemetry
from serve.scheduling.warmup import warm_up
from trackfeatures.errors import UserError

NAME = "driverview"
# High enough that Ray never holds requests back in its proxies: a replica refuses requests that do
# not fit into its queue at once.
MAX_ONGOING = 100
ARGUMENTS = {"model", "replicas", "token_file", "hosts", "cameras", "views"}  # arguments of `build`


@dataclass(frozen=True)
class RayConfig:
    """Options of `serve ray`."""

    model: str = ServiceConfig.model
    host: str = ServiceConfig.host
    port: int = ServiceConfig.port
    replicas: int = 1
    limits: Limits = field(default_factory=Limits)
    cameras: tuple[str, ...] = ()
    """NAME=FILE of each camera that requests can name; the files are read on this machine."""
    views: int = ServiceConfig.views
    """Number of views of each image whose answers are averaged: 1, 2 or 6."""


def _application(folder: str, limits: Limits, cameras: Cameras, views: int) -> Service:
    """Load the engine and create the service of a replica. The replica accepts requests after this
    function returns."""
    engine, tracer = load_engine(Path(folder), views=views), telemetry.tracer()
    warm_up(engine)
    return Service(engine, lambda _engine: None, limits, tracer=tracer, cameras=cameras)


def build(args: dict[str, Any]) -> ray_serve.Application:
    """Build the Ray Serve application. Keys of `args`: `model` as for `serve`, found on this
    machine; `replicas`; `token_file` (default: the token in $DRIVERVIEW_TOKEN); `hosts`, the host
    names that are accepted if there is no token; `cameras`, a list of NAME=FILE, and `views`, as
    for `serve`.

    Raises UserError for another key, an impossible value, or a model or file that is not found.
    """
    unknown = set(args) - ARGUMENTS
    if unknown:
        raise UserError(
            f"unknown argument {', '.join(sorted(unknown))}; known arguments are "
            f"{', '.join(sorted(ARGUMENTS))}"
        )
    token_file = args.get("token_file")
    token = read_token(None if token_file is None else Path(token_file))
    config = RayConfig(
        model=str(args.get("model", ServiceConfig.model)),
        replicas=_count(args, "replicas"),
        limits=Limits(token=token, hosts=_texts(args, "hosts")),
        cameras=_texts(args, "cameras"),
        views=_count(args, "views"),
    )
    return _bind(config)


def _texts(args: dict[str, Any], name: str) -> tuple[str, ...]:
    found = args.get(name, ())
    return (found,) if isinstance(found, str) else tuple(found)


def _count(args: dict[str, Any], name: str) -> int:
    """The value of an argument, 1 without it. Raises UserError for a value below 1."""
    found = str(args.get(name, 1))  # Ray's command line gives text
    if not found.isdecimal() or int(found) < 1:
        raise UserError(f"{name} is {found[:40]}; expected a whole number of at least 1")
    return int(found)


def _bind(config: RayConfig) -> ray_serve.Application:
    """Check the model, the cameras and the number of views, and return Ray's application."""
    folder = resolve_run(config.model).resolve()
    check_count(config.views)
    cameras = read_cameras(config.cameras, read_card(folder).camera)

    def application() -> Service:  # runs in each replica, which then loads the engine
        return _application(str(folder), config.limits, cameras, config.views)

    track = ray_serve.deployment(
        name="track", num_replicas=config.replicas, max_ongoing_requests=MAX_ONGOING
    )
    return track(ray_serve.ingress(application)()).bind()


def run(config: RayConfig) -> None:
    """Serve on Ray until SIGTERM or Ctrl-C. Raises UserError if the service cannot start."""
    folder, application = resolve_run(config.model).resolve(), _bind(config)
    owns_cluster = _connect()
    try:
        ray_serve.start(http_options={"host": config.host, "port": config.port})
        ray_serve.run(application, name=NAME)
        replicas = counted(config.replicas, "replica")
        sys.stderr.write(
            f"serving {folder} on Ray at {url(config.host, config.port)}, {replicas}\n"
        )
        sys.stderr.flush()
        _wait_for_signal()
        ray_serve.delete(NAME)
    finally:
        if owns_cluster:
            _shut_down()


def _connect() -> bool:
    """Join the cluster at $RAY_ADDRESS, or start a local cluster and return True."""
    import ray

    quiet: dict[str, Any] = {"logging_level": "ERROR", "log_to_driver": False}
    address = os.environ.get("RAY_ADDRESS", "local")
    try:
        ray.init(address=address, include_dashboard=False, **quiet)
    except (ConnectionError, RuntimeError, ValueError, OSError) as error:
        raise UserError(f"no Ray cluster could be joined or started ({error})") from error
    return address == "local"


def _shut_down() -> None:
    import ray

    ray_serve.shutdown()  # type: ignore[no-untyped-call]
    ray.shutdown()


def _wait_for_signal() -> None:
    stopped = threading.Event()
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: stopped.set())
    while not stopped.wait(1.0):
        pass
