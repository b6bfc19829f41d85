"""The project's commands as child processes that run to their end, or serve until they are stopped.

A child process that has not ended 10 s after Ctrl-C or SIGTERM is killed.
"""

import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from serve.client import Client
from trackfeatures import UserError

START_LIMIT_S, STOP_LIMIT_S = 60.0, 10.0
"""Time (s) after its start in which the service must be ready, and time (s) after Ctrl-C or SIGTERM
in which a child process must end."""


class Terminated(KeyboardInterrupt):
    """SIGTERM arrived. Unlike Ctrl-C in a terminal, it does not reach the child processes."""


def stop_on_sigterm() -> None:
    """Make SIGTERM end this process as Ctrl-C does."""

    def stop(number: int, frame: object) -> None:
        raise Terminated

    signal.signal(signal.SIGTERM, stop)


def run_module(command: list[str]) -> tuple[int, str]:
    """Run `python -m command...` with this interpreter; returns the exit code and stdout."""
    with subprocess.Popen(
        [sys.executable, "-m", *command], stdout=subprocess.PIPE, text=True
    ) as child:
        try:
            output, _ = child.communicate()
        except KeyboardInterrupt as reason:
            if isinstance(reason, Terminated):
                child.terminate()
            _wait(child)
            raise
    return child.returncode, output


def free_port() -> int:
    """Return a port of the loopback interface that is free at present."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
        return port


@contextmanager
def running_service(model: str, log: Path) -> Iterator[str]:
    """Serve `model`, a name or a run folder; yields the service's address.

    The service writes its output to `log`. Raises UserError with the end of the log if the service
    does not become ready, and UserError if it does not stop.
    """
    port = free_port()
    url = f"http://127.0.0.1:{port}"
    command = [sys.executable, "-m", "serve", "--model", model, "--port", str(port)]
    with (
        log.open("wb") as output,
        subprocess.Popen(command, stdout=output, stderr=output) as server,
    ):
        try:
            _wait_until_ready(server, url, log)
            yield url
        finally:
            server.terminate()
            stopped = _wait(server)
    if not stopped:
        raise UserError(f"the service did not stop within {STOP_LIMIT_S:.0f} s; see {log}")


def _wait_until_ready(server: subprocess.Popen[bytes], url: str, log: Path) -> None:
    try:
        with Client(url) as client:
            client.wait_until_ready(START_LIMIT_S)
    except UserError as error:
        last_lines = log.read_text(errors="replace").strip().splitlines()[-3:]
        state = "still running" if server.poll() is None else f"ended with {server.returncode}"
        raise UserError(
            f"the service is not ready ({state}): {error}; {' | '.join(last_lines)}"
        ) from None


def _wait(child: "subprocess.Popen[bytes] | subprocess.Popen[str]") -> bool:
    """Wait until the process ends, and kill it after `STOP_LIMIT_S` (s). Returns False if it had to
    be killed."""
    try:
        child.wait(STOP_LIMIT_S)
    except subprocess.TimeoutExpired:
        child.kill()
        return False
    return True
