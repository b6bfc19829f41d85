"""The service as an application of Ray Serve (the extra `rayserve`): each replica is one engine.

    serve ray --model runs/latest --replicas 2 --port 8000

starts it, on the cluster of $RAY_ADDRESS or on a Ray of its own on this machine, and ends it with
Ctrl-C. `build` is the same for Ray's own tools, an application builder for their `run`, `deploy`
and configuration files (`import_path: serve.on_ray:build`, `args: {model: /runs/latest}`).

What Ray does itself is left to it: restarts, scaling, the port. So streams and the rate limit are
each replica's own, and the limits on slow clients are those of Ray's proxies.
"""

import signal
import sys
import threading
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ray import serve as ray_serve  # ours is the package `serve`, Ray's is `ray.serve`

from mtlnet.inference.engine import load_engine
from mtlnet.inference.model_card import resolve_run
from serve.app import Service
from serve.config import Limits
from serve.observability import telemetry
from serve.scheduling.warmup import warm_up
from trackfeatures.errors import UserError

NAME = "driverview"
# A replica refuses by itself what does not fit into its queue, at once and with a reason; Ray, at
# its own limit, would let requests wait in its proxies.
MAX_ONGOING = 100


@dataclass(frozen=True)
class RayConfig:
    """What `serve ray` is asked to do."""

    model: str = "default"
    host: str = "127.0.0.1"
    port: int = 8000
    replicas: int = 1
    limits: Limits = field(default_factory=Limits)


def _application(folder: str, limits: Limits) -> Service:
    """What each replica makes when it starts; it takes requests once this is through."""
    engine = load_engine(Path(folder))
    warm_up(engine)
    return Service(engine, lambda _engine: None, limits, tracer=telemetry.tracer())


def build(args: dict[str, Any]) -> ray_serve.Application:
    """The application; `args`: `model` as for `serve`, found on this machine, and `replicas`."""
    unknown = set(args) - {"model", "replicas"}
    if unknown:
        raise UserError(
            f"there is no argument {', '.join(sorted(unknown))}; model and replicas are"
        )
    folder = resolve_run(str(args.get("model", "default"))).resolve()
    return _bind(folder, int(args.get("replicas", 1)), Limits())


def _bind(folder: Path, replicas: int, limits: Limits) -> ray_serve.Application:
    def application() -> Service:  # Ray sends it to the replicas, which have no engine before
        return _application(str(folder), limits)

    track = ray_serve.deployment(
        name="track", num_replicas=replicas, max_ongoing_requests=MAX_ONGOING
    )
    return track(ray_serve.ingress(application)()).bind()


def run(config: RayConfig) -> None:
    """Serve on Ray until SIGTERM or Ctrl-C. Raises UserError when it cannot begin."""
    folder = resolve_run(config.model).resolve()
    started = _join()
    try:
        ray_serve.start(http_options={"host": config.host, "port": config.port})
        ray_serve.run(_bind(folder, config.replicas, config.limits), name=NAME)
        url = f"http://{config.host}:{config.port}"
        sys.stderr.write(f"serving {folder} on Ray at {url}, {config.replicas} replicas\n")
        sys.stderr.flush()
        _wait()
        ray_serve.delete(NAME)
    finally:
        if started:
            _leave()


def _join() -> bool:
    """Be part of a Ray cluster; whether it is one of our own."""
    import ray

    quiet: dict[str, Any] = {"logging_level": "ERROR", "log_to_driver": False}
    try:
        ray.init(address="auto", **quiet)
    except ConnectionError:
        ray.init(address="local", include_dashboard=False, **quiet)
        return True
    return False


def _leave() -> None:
    import ray

    ray_serve.shutdown()  # type: ignore[no-untyped-call]
    ray.shutdown()


def _wait() -> None:
    told = threading.Event()
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: told.set())
    while not told.wait(1.0):
        pass
