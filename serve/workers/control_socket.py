"""Asking a running service for new weights or new workers: over a Unix socket, never over HTTP.

The socket lies in a folder that only its owner may enter; its name holds the service's port.
"""

import asyncio
import json
import logging
import os
import socket
import tempfile
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any

from trackfeatures.errors import UserError

WAIT_S = 180.0

logger = logging.getLogger(__name__)

Command = Callable[[str | None], Awaitable[str]]


def socket_path(port: int) -> Path:
    """Where the service on `port` listens for its owner."""
    base = os.environ.get("XDG_RUNTIME_DIR")
    folder = Path(base) if base else Path(tempfile.gettempdir()) / f"driverview-{os.getuid()}"
    return folder / f"driverview-serve-{port}.sock"


def ask(port: int, command: str, model: str | None = None) -> str:
    """Ask the service on `port`; what it answers. Raises UserError."""
    path = socket_path(port)
    with socket.socket(socket.AF_UNIX) as connection:
        connection.settimeout(WAIT_S)
        try:
            connection.connect(str(path))
            connection.sendall(json.dumps({"command": command, "model": model}).encode() + b"\n")
            with connection.makefile("r") as file:
                line = file.readline()
        except TimeoutError:
            raise UserError(f"the service gave no answer within {WAIT_S:g} s") from None
        except OSError:
            raise UserError(
                f"no service of yours on port {port} can be asked (looked for {path}); give its "
                "--port, or send its process SIGHUP"
            ) from None
    if not line:
        raise UserError("the service ended before it answered")
    answer = json.loads(line)
    if not answer["ok"]:
        raise UserError(answer["text"])
    return str(answer["text"])


async def listen(port: int, commands: dict[str, Command]) -> asyncio.Server | None:
    """Take commands for the service on `port`; None where no socket can be made."""
    path = socket_path(port)

    async def answer(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        content = await _attempt(await reader.readline(), commands)
        writer.write(json.dumps(content).encode() + b"\n")
        writer.close()

    try:
        path.parent.mkdir(mode=0o700, exist_ok=True)
        if path.parent.stat().st_uid != os.getuid():
            raise PermissionError(f"{path.parent} is another user's")
        path.unlink(missing_ok=True)
        server = await asyncio.start_unix_server(answer, str(path))
        path.chmod(0o600)
    except OSError as error:  # a read-only disk: signals still work
        logger.warning("no `serve reload` for this service (%s); SIGHUP does the same", error)
        return None
    return server


async def _attempt(line: bytes, commands: dict[str, Command]) -> dict[str, Any]:
    try:
        message = json.loads(line)
        return {"ok": True, "text": await commands[message["command"]](message["model"])}
    except UserError as error:
        return {"ok": False, "text": str(error)}
    except (ValueError, KeyError, TypeError):
        return {"ok": False, "text": "this is no command of the service"}
