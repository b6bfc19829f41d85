"""Starts the service (checks, listening sockets, first line on stderr) and shuts it down cleanly.

Each worker process has one engine, which computes one answer at a time. All workers share the
listening sockets; `serve.workers.supervisor` manages them.
"""

import asyncio
import socket
import sys
from functools import partial
from pathlib import Path

from mtlnet.inference.model_card import read_card, resolve_run
from runtime.access import check_exposure
from runtime.processor import has_bf16, has_int8, usable_cores
from runtime.sockets import address, bind_all, shown_addresses
from serve.config import ServiceConfig
from serve.observability import logs, telemetry
from serve.workers.control_socket import listen_for_commands, socket_path
from serve.workers.supervisor import ServicePlan, Supervisor
from trackfeatures.camera import CameraParameters


def run(config: ServiceConfig) -> None:
    """Serve until SIGTERM or Ctrl-C. Raises UserError if the service cannot start."""
    logs.set_up()
    check_exposure(config.host, config.limits.token, config.insecure)
    # A missing exporter or model is reported here, before any process is started.
    telemetry.exporter_name()
    resolve_run(config.model)
    listeners = bind_all(config.host, config.port)
    asyncio.run(_serve(config, listeners))


async def _serve(config: ServiceConfig, listeners: list[socket.socket]) -> None:
    cameras = partial(_cameras, config.cameras)
    plan = ServicePlan(
        config.model,
        resolve_run,
        config.workers,
        config.limits,
        cameras,
        config.views,
        config.threads or default_threads(config.workers),
    )
    supervisor = Supervisor(plan, listeners)
    port = listeners[0].getsockname()[1]
    first = await supervisor.start()
    if first is None:
        return
    sys.stderr.write(
        f"serving {_model_label(config.model, supervisor.folder)}, model {first['model'][:12]}, "
        f"with {first['engine']} {first['precision']}"
        f"{f' on {plan.threads} threads' if plan.threads > 1 else ''}"
        f"{f' and --views {config.views}' if config.views > 1 else ''} "
        f"at {address(listeners[0], config.host)}"
        f"{f' ({shown_addresses(listeners)})' if len(listeners) > 1 else ''}"
        f"{f', {config.workers} workers' if config.workers > 1 else ''}\n"
    )
    sys.stderr.flush()

    async def reload(model: str | None) -> str:
        return f"now serving model {(await supervisor.reload(model))[:12]}"

    async def restart(_model: str | None) -> str:
        await supervisor.restart()
        return "all workers were replaced"

    command_server = await listen_for_commands(port, {"reload": reload, "restart": restart})
    await supervisor.run()
    if command_server is not None:
        command_server.close()
        socket_path(port).unlink(missing_ok=True)


def default_threads(workers: int) -> int:
    """Return the number of threads with which each of `workers` workers computes an answer.

    It is 2 if each worker has two cores and the processor has no instructions for int8 and bf16.
    An answer then takes 0.7 of its time with one thread. With these instructions a forward pass is
    so short that two threads take longer than one (docs/experiments/service-load.md).
    """
    slow = not (has_int8() or has_bf16())
    return 2 if slow and usable_cores() >= 2 * workers else 1


def _cameras(options: tuple[str, ...], run: Path) -> dict[str, CameraParameters]:
    """Read the cameras of `--camera` for the model in the folder `run`. Raises UserError, also if a
    camera does not show enough of the model's view."""
    if not options:
        return {}
    from serve.cameras import read_cameras  # imported late: loading OpenCV delays the workers

    return read_cameras(options, read_card(run).camera)


def _model_label(model: str, folder: Path) -> str:
    return model if model == str(folder) else f"{model} ({folder})"
