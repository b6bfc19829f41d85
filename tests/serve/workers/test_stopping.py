"""A service stops or replaces its workers: no client gets a reset or an empty reply."""

import http.client
import itertools
import signal
import socket
import subprocess
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

import pytest

from serve.client import Client
from serve.workers.control_socket import send_command
from tests.serve.conftest import JPEG, PATIENCE_S
from tests.serve.test_cli import ROOT, address, command, started


class Clients:
    """Clients in threads that repeat their request until the service refuses connections."""

    def __init__(self, port: int) -> None:
        self.port = port
        self.counts: Counter[str] = Counter()
        self._stop = threading.Event()
        self._threads: list[threading.Thread] = []

    def run(self, ask: Callable[[], str]) -> None:
        """Repeat `ask` in a new thread, and count the outcomes that it returns."""

        def loop() -> None:
            while not self._stop.is_set():
                try:
                    self.counts[ask()] += 1
                except ConnectionRefusedError:
                    self.counts["refused"] += 1
                    return
                except (OSError, http.client.HTTPException) as error:
                    self.counts[f"{ask.__name__}: {error!r}"] += 1

        self._threads.append(threading.Thread(target=loop))
        self._threads[-1].start()

    def join(self) -> Counter[str]:
        """The counted outcomes, after all clients were refused."""
        end = time.monotonic() + PATIENCE_S
        for thread in self._threads:
            thread.join(max(0.0, end - time.monotonic()))
        self._stop.set()
        return self.counts

    def stop(self) -> Counter[str]:
        """Stop the clients; returns the outcomes counted so far."""
        self._stop.set()
        return self.join()

    def new_each_time(self) -> str:
        """Send a small request on a new connection."""
        return self._ask_anew("GET", "/healthz")

    def large(self) -> str:
        """Send a large body, which is refused, on a new connection."""
        return self._ask_anew("POST", "/features", bytes(1 << 20), {"Content-Type": "image/png"})

    def _ask_anew(self, *request: Any) -> str:
        connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=PATIENCE_S)
        with closing(connection):
            connection.request(*request)
            return reply_of(connection)

    def late(self) -> str:
        """Send a request 0.1 s after the connection was made."""
        with socket.create_connection(("127.0.0.1", self.port), PATIENCE_S) as connection:
            time.sleep(0.1)
            connection.sendall(b"GET /healthz HTTP/1.1\r\nHost: localhost\r\n\r\n")
            return connection.recv(65536).split()[1].decode()

    def keeper(self) -> Callable[[], str]:
        """A function that sends an image on the same connection at each call, until the service
        announces that it closes the connection."""
        connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=PATIENCE_S)

        def keep_alive() -> str:
            connection.request("POST", "/features", JPEG, {"Content-Type": "image/jpeg"})
            return reply_of(connection)

        return keep_alive


def reply_of(connection: http.client.HTTPConnection) -> str:
    response = connection.getresponse()
    response.read()
    return str(response.status)


@contextmanager
def running(published: Path, *arguments: str) -> Iterator[tuple[subprocess.Popen[str], int]]:
    """A ready service; yields its process and its port."""
    with started("--model", str(published), "--port", "0", *arguments) as (process, line):
        url = address(line)
        with Client(url, timeout_s=PATIENCE_S) as client:
            client.wait_until_ready(PATIENCE_S)
        yield process, int(url.rpartition(":")[2])


@pytest.mark.slow
@pytest.mark.parametrize("workers", ["1", "2"])
def test_no_client_sees_a_reset_when_the_service_stops(published: Path, workers: str) -> None:
    with running(published, "--workers", workers) as (process, port):
        clients = Clients(port)
        for ask in (clients.new_each_time, clients.new_each_time, clients.large, clients.late):
            clients.run(ask)
        clients.run(clients.keeper())
        time.sleep(0.3)
        for _ in range(2):  # a second signal has no effect
            process.send_signal(signal.SIGTERM)
            time.sleep(0.05)
        assert process.wait(PATIENCE_S) == 0
        counts = clients.join()
    assert set(counts) <= {"200", "422", "503", "refused"}, counts
    assert counts["refused"] == 5
    assert min(counts["200"], counts["503"]) > 0


@pytest.mark.extended
@pytest.mark.slow
def test_no_client_sees_a_reset_when_workers_are_replaced(published: Path) -> None:
    with running(published, "--workers", "2") as (process, port):
        clients = Clients(port)
        for ask in (clients.new_each_time, clients.late, clients.keeper()):
            clients.run(ask)
        assert "replaced" in send_command(port, "restart")
        assert "now serving" in send_command(port, "reload")
        counts = clients.stop()
        process.send_signal(signal.SIGTERM)
        assert process.wait(PATIENCE_S) == 0
    assert set(counts) <= {"200", "503"}, counts
    assert counts["200"] > 0


@pytest.mark.slow
def test_connections_that_wait_while_the_model_loads_are_answered_when_it_stops(
    published: Path,
) -> None:
    with running(published) as (first, port):
        first.send_signal(signal.SIGTERM)
        first.wait(PATIENCE_S)
    # Start the service again on this port, and stop it before a worker can accept connections.
    with started_without_line(published, port) as process:
        connection = dial(port)
        connection.sendall(b"HEAD /v2 HTTP/1.1\r\nHost: localhost\r\n\r\n")
        process.send_signal(signal.SIGTERM)
        with connection:
            reply = b"".join(iter(lambda: connection.recv(65536), b""))
        assert process.wait(PATIENCE_S) == 0
    assert reply.startswith(b"HTTP/1.1 503")
    assert b"connection: close" in reply
    assert reply.endswith(b"\r\n\r\n")  # HEAD gets no body
    with pytest.raises(ConnectionRefusedError):
        dial(port, tries=1)


@contextmanager
def started_without_line(published: Path, port: int) -> Iterator[subprocess.Popen[str]]:
    words = command("--model", str(published), "--port", str(port))
    with subprocess.Popen(words, text=True, cwd=ROOT, env={"PYTHONPATH": str(ROOT)}) as process:
        try:
            yield process
        finally:
            process.kill()


def dial(port: int, tries: int | None = None) -> socket.socket:
    """A connection, made as soon as the service listens."""
    for number in itertools.count(1):
        try:
            return socket.create_connection(("127.0.0.1", port), PATIENCE_S)
        except ConnectionRefusedError:
            if number == tries:
                raise
            time.sleep(0.01)
    raise AssertionError
