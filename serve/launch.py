"""Running the service: what it may listen on, the socket, the first line, a clean end.

One process is one engine with one thread (two in one process lose throughput to each other); the
workers share the socket. `serve.workers.supervisor` watches over them.
"""

import asyncio
import os
import socket
import sys
from dataclasses import dataclass, field
from pathlib import Path

from mtlnet.inference.model_card import resolve_run
from runtime.sockets import address, bind
from serve.config import TOKEN_VARIABLE, Limits, is_loopback
from serve.observability import logs, telemetry
from serve.workers.control_socket import listen, socket_path
from serve.workers.supervisor import ServicePlan, Supervisor
from trackfeatures.errors import UserError

BACKLOG = 2048
MIN_TOKEN = 16


@dataclass(frozen=True)
class ServiceConfig:
    """What `serve` is asked to do."""

    model: str = "default"
    """A run's folder, its name in runs/, "latest" or "default"."""
    host: str = "127.0.0.1"
    port: int = 8000
    """0: any free one; the first line says which."""
    workers: int = 1
    insecure: bool = False
    """Listen on other addresses than this machine's own without a token."""
    limits: Limits = field(default_factory=Limits)


def read_token(path: Path | None) -> str | None:
    """The token in a file, else in the environment, else None. Raises UserError."""
    if path is None:
        token = os.environ.get(TOKEN_VARIABLE, "").strip()
        where = f"${TOKEN_VARIABLE}"
    elif path.is_file():
        token, where = path.read_text(encoding="utf-8").strip(), str(path)
    else:
        raise UserError(
            f"there is no token file {path}; write one, `openssl rand -hex 32` gives one"
        )
    if not token:
        if path is not None:
            raise UserError(f"{where} is empty; `openssl rand -hex 32` gives a token")
        return None
    if len(token) < MIN_TOKEN or not (token.isascii() and token.isprintable() and " " not in token):
        raise UserError(
            f"the token in {where} must be {MIN_TOKEN} or more printable ASCII characters without "
            "a space; `openssl rand -hex 32` gives one"
        )
    return token


def run(config: ServiceConfig) -> None:
    """Serve until SIGTERM or Ctrl-C. Raises UserError when it cannot begin."""
    logs.set_up()
    check_exposure(config.host, config.limits.token, config.insecure)
    # What is not there is told before any process is started.
    telemetry.exporter_name()
    resolve_run(config.model)
    listener = bind(config.host, config.port)
    asyncio.run(_serve(config, listener))


def check_exposure(host: str, token: str | None, insecure: bool) -> None:
    """Raise UserError where others than this machine could use the service unasked."""
    if is_loopback(host) or token is not None or insecure:
        return
    raise UserError(
        f"--host {host} is open to others than this machine: set a token (--token-file, or "
        f"{TOKEN_VARIABLE} in the environment), or say --insecure where a proxy guards the service"
    )


async def _serve(config: ServiceConfig, listener: socket.socket) -> None:
    plan = ServicePlan(config.model, resolve_run, config.workers, config.limits)
    supervisor = Supervisor(plan, listener)
    listener.listen(BACKLOG)
    first = await supervisor.start()
    sys.stderr.write(
        f"serving {_named(config.model, supervisor.folder)}, model {first['model'][:12]}, with "
        f"{first['engine']} {first['precision']} at {address(listener, config.host)}"
        f"{f', {config.workers} workers' if config.workers > 1 else ''}\n"
    )
    sys.stderr.flush()

    async def reload(model: str | None) -> str:
        return f"now serving model {(await supervisor.reload(model))[:12]}"

    async def restart(_model: str | None) -> str:
        await supervisor.restart()
        return "all workers were replaced"

    port = listener.getsockname()[1]
    commands = await listen(port, {"reload": reload, "restart": restart})
    await supervisor.run()
    if commands is not None:
        commands.close()
        socket_path(port).unlink(missing_ok=True)


def _named(model: str, folder: Path) -> str:
    return model if model == str(folder) else f"{model} ({folder})"
