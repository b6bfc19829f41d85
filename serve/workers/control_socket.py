"""Sends commands (`reload`, `restart`) to a running service over a Unix socket, not over HTTP.

The socket is in a folder that only its owner can enter; its name contains the service's port.
Command and answer are one line of JSON each: {"command", "model"}, then {"ok", "text"}.
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

ANSWER_TIMEOUT_S = 180.0
RUNTIME_FOLDERS = Path("/run/user")
"""Folder in which systemd creates the XDG_RUNTIME_DIR of each user, named by the user's number."""

logger = logging.getLogger(__name__)

Command = Callable[[str | None], Awaitable[str]]


def socket_path(port: int) -> Path:
    """Return the path of the control socket of a service on `port` that has our environment."""
    return _possible_paths(port)[0]


def _possible_paths(port: int) -> list[Path]:
    """Return all paths that the control socket of the service on `port` can have. systemd and cron
    set no XDG_RUNTIME_DIR, so that the environment of the service can differ from ours."""
    user = str(os.getuid())
    base = os.environ.get("XDG_RUNTIME_DIR")
    folders = [Path(base)] if base else []
    folders += [Path(tempfile.gettempdir()) / f"driverview-{user}", RUNTIME_FOLDERS / user]
    return [folder / f"driverview-serve-{port}.sock" for folder in dict.fromkeys(folders)]


def send_command(port: int, command: str, model: str | None = None) -> str:
    """Send `command` (reload or restart), with `model` as the new model, to the service on `port`
    and return its answer.

    Raises UserError if no service of this user is found, if it does not answer in time, or if it
    answers with an error.
    """
    paths = _possible_paths(port)
    path = next((p for p in paths if _is_ours(p.parent) and _accepts(p)), paths[0])
    with socket.socket(socket.AF_UNIX) as connection:
        connection.settimeout(ANSWER_TIMEOUT_S)
        try:
            _check_owner(path.parent)
            connection.connect(str(path))
            connection.sendall(json.dumps({"command": command, "model": model}).encode() + b"\n")
            with connection.makefile("r") as file:
                line = file.readline()
        except TimeoutError:
            raise UserError(
                f"the service did not answer within {ANSWER_TIMEOUT_S:g} s; see its log"
            ) from None
        except OSError:
            raise UserError(
                f"found no service of yours on port {port} (no socket "
                f"{' or '.join(map(str, paths))}); give its --port, or send SIGHUP to its process"
            ) from None
    if not line:
        raise UserError("the service stopped before it answered; see its log")
    answer = json.loads(line)
    if not answer["ok"]:
        raise UserError(answer["text"])
    return str(answer["text"])


async def listen_for_commands(port: int, commands: dict[str, Command]) -> asyncio.Server | None:
    """Accept commands for the service on `port`: each function in `commands` gets a model's name or
    None and returns the answer. Returns None if no socket can be created."""
    path = socket_path(port)

    async def handle(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        content = await _execute(await reader.readline(), commands)
        writer.write(json.dumps(content).encode() + b"\n")
        writer.close()

    try:
        path.parent.mkdir(mode=0o700, exist_ok=True)
        _check_owner(path.parent)
        if _accepts(path):
            raise FileExistsError(f"{path} belongs to another service on port {port}")
        path.unlink(missing_ok=True)
        server = await asyncio.start_unix_server(handle, str(path))
        path.chmod(0o600)
    except OSError as error:  # a read-only disk, for example; signals still work
        logger.warning("`serve reload` is not available (%s); send SIGHUP instead", error)
        return None
    return server


async def _execute(line: bytes, commands: dict[str, Command]) -> dict[str, Any]:
    try:
        message = json.loads(line)
        command, model = commands[message["command"]], message["model"]
    except (ValueError, KeyError, TypeError):
        return {"ok": False, "text": f"unknown command; known commands are {', '.join(commands)}"}
    try:
        return {"ok": True, "text": await command(model)}
    except (UserError, OSError) as error:
        return {"ok": False, "text": str(error)}
    except Exception as error:  # the service must not stop
        logger.exception("a command failed")
        return {"ok": False, "text": f"the service failed ({error!r}); see its log"}


def _accepts(path: Path) -> bool:
    """Whether a process listens on the socket at `path`."""
    with socket.socket(socket.AF_UNIX) as connection:
        connection.settimeout(1.0)
        try:
            connection.connect(str(path))
        except OSError:
            return False
    return True


def _is_ours(folder: Path) -> bool:
    """Whether this user owns the folder; anyone can create its known name."""
    try:
        return folder.stat().st_uid == os.getuid()
    except OSError:
        return False


def _check_owner(folder: Path) -> None:
    """Raise PermissionError if another user owns the folder, OSError if there is none."""
    if folder.stat().st_uid != os.getuid():
        raise PermissionError(f"{folder} belongs to another user")
