"""The project's commands as child processes: run to the end, or started and stopped (the service).

On Ctrl-C and SIGTERM the child processes get `STOP_LIMIT_S` to end by themselves.
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

START_LIMIT_S = 60.0
STOP_LIMIT_S = 10.0


class Terminated(KeyboardInterrupt):
    """SIGTERM: unlike Ctrl-C in a terminal, it does not reach the child processes by itself."""


def stop_on_sigterm() -> None:
    """Make SIGTERM end this process as Ctrl-C does."""

    def stop(number: int, frame: object) -> None:
        raise Terminated

    signal.signal(signal.SIGTERM, stop)


def run_module(command: list[str]) -> tuple[int, str]:
    """Run `python -m command...` with this interpreter; its exit code and standard output."""
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
    """A port of the loopback interface that is free now."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
        return port


@contextmanager
def running_service(model: str, log: Path) -> Iterator[str]:
    """Serve the model of that name or run folder; yields the service's address.

    Raises UserError with the end of the log if the service does not become ready or does not stop.
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
            stopped = _stop(server)
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


def _stop(server: subprocess.Popen[bytes]) -> bool:
    server.terminate()
    return _wait(server)


def _wait(child: "subprocess.Popen[bytes] | subprocess.Popen[str]") -> bool:
    """Wait `STOP_LIMIT_S` for the process to end; False when it had to be killed."""
    try:
        child.wait(STOP_LIMIT_S)
    except subprocess.TimeoutExpired:
        child.kill()
        return False
    return True
