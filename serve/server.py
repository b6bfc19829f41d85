"""Running the service: the socket, the worker processes, the first line, a clean end.

One process is one engine with one thread (two in one process lose throughput to each other); with
several workers the processes share the socket, and the kernel deals the connections out.
"""

import os
import signal
import socket
import sys
from dataclasses import dataclass
from pathlib import Path
from types import FrameType

import uvicorn
from uvicorn.supervisors import Multiprocess

from mtlnet.card import resolve_run
from mtlnet.engine import load_engine
from serve.app import Service, create_app
from trackfeatures.errors import UserError
from trackfeatures.listening import address, bind

RUN_VARIABLE = "DRIVERVIEW_SERVE_RUN"  # how the parent tells its workers which model to load
BACKLOG = 2048
KEEP_ALIVE_S = 30
GRACE_S = 5  # for requests in progress when the service is told to stop


@dataclass(frozen=True)
class ServiceConfig:
    """What `serve` is asked to do."""

    model: str = "default"
    """A run's folder, its name in runs/, "latest" or "default"."""
    host: str = "127.0.0.1"
    port: int = 8000
    """0: any free one; the first line says which."""
    workers: int = 1


def run(config: ServiceConfig) -> None:
    """Serve until SIGTERM or Ctrl-C. Raises UserError when it cannot begin."""
    folder = resolve_run(config.model)
    listener = bind(config.host, config.port)
    # Loaded here even when only the workers use it: a model that cannot be loaded is then one
    # clear line and not one traceback a worker.
    engine = load_engine(folder)
    sys.stderr.write(
        f"serving {_named(config.model, folder)}, model {engine.card.model_hash[:12]}, with "
        f"{engine.kind} {engine.precision} at {address(listener, config.host)}"
        f"{f', {config.workers} workers' if config.workers > 1 else ''}\n"
    )
    sys.stderr.flush()
    listener.listen(BACKLOG)
    if config.workers == 1:
        _run_here(create_app(engine), listener)
    else:
        del engine
        _run_workers(folder, config.workers, listener)


def worker_app() -> Service:
    """The application of one worker process: uvicorn calls this there."""
    return create_app(load_engine(Path(os.environ[RUN_VARIABLE])))


def _run_here(app: Service, listener: socket.socket) -> None:
    # uvicorn raises the signal that ended it once more when all is closed: it has done its work.
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, _ignore)
    server = uvicorn.Server(settings(app))
    server.run(sockets=[listener])
    if not server.started:
        raise UserError("the service could not start; the lines above say why")


def _run_workers(folder: Path, workers: int, listener: socket.socket) -> None:
    os.environ[RUN_VARIABLE] = str(folder.resolve())
    config = settings("serve.server:worker_app", factory=True, workers=workers)
    Multiprocess(config, sockets=[listener]).run()


def settings(
    app: Service | str, *, factory: bool = False, workers: int | None = None
) -> uvicorn.Config:
    """How uvicorn runs the application, or the factory named by an import string."""
    return uvicorn.Config(
        app,
        factory=factory,
        workers=workers,
        loop="uvloop",
        http="httptools",
        ws="none",
        lifespan="on",
        log_level="warning",
        access_log=False,
        server_header=False,
        timeout_keep_alive=KEEP_ALIVE_S,
        timeout_graceful_shutdown=GRACE_S,
    )


def _ignore(_number: int, _frame: FrameType | None) -> None:
    pass


def _named(model: str, folder: Path) -> str:
    return model if model == str(folder) else f"{model} ({folder})"
