"""Raw sockets for attacks, on loopback addresses only; every wait has a time limit."""

import gc
import json
import os
import socket
import struct
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from tests.serve.conftest import FakeEngine, Served, outputs, serving, until

WAIT_S = 60.0  # time limit of a step of an attack; long enough on a busy machine
TEXT, BINARY, CONTINUATION, CLOSE, PING = 1, 2, 0, 8, 9


@dataclass(frozen=True)
class Target:
    """A service on this machine; `token` is its token, None if it needs none."""

    port: int
    token: str | None = None
    source: str = "127.0.0.1"
    """The address from which the attack connects."""

    def headers(self, **more: str) -> bytes:
        """The header lines for Host, the token, and `more`."""
        sent = {"Host": f"127.0.0.1:{self.port}", **more}
        if self.token is not None:
            sent.setdefault("Authorization", f"Bearer {self.token}")
        lines = (f"{name.replace('_', '-')}: {value}\r\n" for name, value in sent.items())
        return "".join(lines).encode()

    def dial(self) -> socket.socket:
        """A new connection."""
        return socket.create_connection(("127.0.0.1", self.port), WAIT_S, (self.source, 0))

    def open_websocket(self, **headers: str) -> socket.socket:
        """A connection whose handshake was accepted."""
        connection = self.dial()
        connection.sendall(self.handshake(**headers))
        reply = read_head(connection)
        assert reply.startswith(b"HTTP/1.1 101"), reply
        return connection

    def handshake(self, **headers: str) -> bytes:
        """The request that opens a WebSocket."""
        return b"GET /stream HTTP/1.1\r\n%b\r\n" % self.headers(
            Connection="Upgrade",
            Upgrade="websocket",
            Sec_WebSocket_Version="13",
            Sec_WebSocket_Key="AAAAAAAAAAAAAAAAAAAAAA==",
            **headers,
        )

    def ask(self, method: str = "GET", path: str = "/healthz", **headers: str) -> bytes:
        """A complete request without a body."""
        return f"{method} {path} HTTP/1.1\r\n".encode() + self.headers(**headers) + b"\r\n"

    def post(self, body: bytes, path: str = "/features", **headers: str) -> bytes:
        """A complete request with an image."""
        sent = {"Content_Type": "image/jpeg", "Content_Length": str(len(body)), **headers}
        return f"POST {path} HTTP/1.1\r\n".encode() + self.headers(**sent) + b"\r\n" + body


def frame(opcode: int, payload: bytes = b"", fin: bool = True) -> bytes:
    """A WebSocket frame, masked with zeros."""
    size = len(payload)
    if size < 126:
        head = bytes([fin << 7 | opcode, 0x80 | size])
    elif size < 1 << 16:
        head = struct.pack("!BBH", fin << 7 | opcode, 0x80 | 126, size)
    else:
        head = struct.pack("!BBQ", fin << 7 | opcode, 0x80 | 127, size)
    return head + bytes(4) + payload


def send_all(connection: socket.socket, sent: bytes, most: int = 1) -> int:
    """Send `sent` up to `most` times, until the service ends the connection; returns the number of
    bytes sent."""
    done = 0
    for _ in range(most):
        try:
            connection.sendall(sent)
        except OSError:
            break
        done += len(sent)
    return done


def read_head(connection: socket.socket) -> bytes:
    """The bytes received up to the end of the headers."""
    received = b""
    while b"\r\n\r\n" not in received:
        part = connection.recv(1)
        if not part:
            break
        received += part
    return received


def read_rest(connection: socket.socket) -> bytes:
    """The bytes received until the service ends the connection."""
    received = b""
    with suppress(ConnectionError):
        while part := connection.recv(1 << 16):
            received += part
    return received


def read_reply(connection: socket.socket) -> tuple[int, Any]:
    """The status and the JSON of one reply."""
    head = read_head(connection)
    length = int(head.lower().partition(b"content-length: ")[2].split(b"\r\n")[0])
    body = b""
    while len(body) < length:
        body += connection.recv(length - len(body))
    return int(head.split()[1]), json.loads(body)


def read_close(connection: socket.socket) -> tuple[int, str]:
    """The code and the reason in the service's close frame."""
    received = read_rest(connection)
    at = 0
    while at < len(received):
        opcode, size, head = received[at] & 15, received[at + 1], 2
        if size == 126:
            size, head = int.from_bytes(received[at + 2 : at + 4], "big"), 4
        payload = received[at + head : at + head + size]
        if opcode == CLOSE:
            return int.from_bytes(payload[:2], "big"), payload[2:].decode()
        at += head + size
    raise AssertionError(f"no close frame in {received[-200:]!r}")


def resident_mb(pid: int | str = "self") -> float:
    """The resident memory of a process in MB."""
    pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


def types_in_cycles(work: Callable[[], object]) -> list[type]:
    """The types of the objects that `work` leaves in reference cycles. They stay in memory until a
    garbage collection, which would delay all clients."""
    gc.collect()
    gc.disable()
    gc.set_debug(gc.DEBUG_SAVEALL)
    try:
        work()
        gc.collect()
        return [type(found) for found in gc.garbage]
    finally:
        gc.set_debug(0)
        gc.garbage.clear()
        gc.enable()


@contextmanager
def uncollected(most_mb: float = 30) -> Iterator[None]:
    """Without the garbage collector; in the end at most `most_mb` MB more are resident."""
    gc.collect()
    gc.disable()
    before = resident_mb()
    try:
        yield
        until(lambda: resident_mb() - before < most_mb)
    finally:
        gc.enable()


@pytest.fixture
def service(engine: FakeEngine) -> Iterator[Served]:
    """The service without a token."""
    with serving(engine) as served:
        yield served


@pytest.fixture
def target(service: Served) -> Target:
    """The address of `service`."""
    return Target(service.port)


@pytest.fixture
def engine() -> FakeEngine:
    """A fake engine that does not keep its images."""

    def respond(_image: object) -> Any:
        found.images.clear()
        return outputs()

    found = FakeEngine(respond)
    return found


def close(connections: list[socket.socket]) -> None:
    for connection in connections:
        connection.close()


def open_count(service: Served) -> int:
    return len(service.server.server_state.connections)


def status_of(received: bytes) -> int:
    return int(received.split()[1])
