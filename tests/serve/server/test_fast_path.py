"""POST /features without ASGI: the engine's thread, the order of replies, bodies."""

import contextlib
import socket
import threading
import time
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from serve.config import MAX_BODY_BYTES, Limits
from serve.scheduling import frame_queue, rate_limit
from serve.scheduling.frame_queue import INLINE_AFTER, INLINE_MAX_MS
from serve.server.fast_path import DirectProtocol
from tests.serve.attacks.conftest import read_reply, read_rest, types_in_cycles
from tests.serve.conftest import (
    HEAD,
    JPEG,
    PATIENCE_S,
    WHOLE,
    Clock,
    FakeEngine,
    Served,
    constant_engine,
    jpeg,
    outputs,
    picture,
    serving,
    until,
)


class RecordingEngine(FakeEngine):
    """An engine that records its thread, with a simulated time of `frame_ms` per frame.

    It replaces the frame queue's clock, so that a busy machine makes no frame slow. A frame waits
    until `open` is set; `busy` is set when the engine begins a frame.
    """

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        super().__init__(self._respond)
        self.threads: list[str] = []
        self.frame_ms = 1.0
        self.open, self.busy = threading.Event(), threading.Event()
        self.open.set()
        self._now_ns = time.monotonic_ns()
        monkeypatch.setattr(frame_queue, "time", self)

    def monotonic_ns(self) -> int:
        return self._now_ns

    def _respond(self, _image: NDArray[np.uint8]) -> NDArray[np.float32]:
        self.threads.append(threading.current_thread().name)
        self._now_ns += round(1e6 * self.frame_ms)
        self.busy.set()
        assert self.open.wait(PATIENCE_S)
        return outputs()


def read(connection: socket.socket, count: int) -> list[tuple[int, dict[str, Any]]]:
    """The status and content of the next `count` replies."""
    return [read_reply(connection) for _ in range(count)]


def dial(service: Served) -> socket.socket:
    return socket.create_connection(("127.0.0.1", service.port), PATIENCE_S)


def test_a_single_frame_of_a_fast_engine_is_processed_on_the_event_loop(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    engine = RecordingEngine(monkeypatch)
    large = jpeg(picture(1120, 840))
    with serving(engine) as service:

        def ask(image: bytes = JPEG) -> str:
            assert service.post(image).status == 200
            return engine.threads[-1]

        def on_the_loop() -> bool:
            return ask() != "forward"

        assert [ask() for _ in range(INLINE_AFTER)] == ["forward"] * INLINE_AFTER
        until(on_the_loop)  # waits until the thread sleeps
        assert ask(large) == "forward"
        until(on_the_loop)
        engine.frame_ms = 1.1 * INLINE_MAX_MS
        ask()
        assert [ask() for _ in range(3)] == ["forward"] * 3  # now the engine counts as slow


def test_frames_that_arrive_together_go_to_the_thread(monkeypatch: pytest.MonkeyPatch) -> None:
    engine = RecordingEngine(monkeypatch)
    with serving(engine) as service:
        first, *others = clients = [dial(service) for _ in range(4)]
        for client in clients:  # the service reads from all
            client.sendall(WHOLE)
            assert read(client, 1)[0][0] == 200
        until(lambda: service.post(JPEG).status == 200 and engine.threads[-1] != "forward")
        for _ in range(5):
            engine.open.clear()
            engine.busy.clear()
            first.sendall(WHOLE)
            assert engine.busy.wait(PATIENCE_S)
            for client in others:
                client.sendall(WHOLE)
            engine.open.set()
            assert [read(client, 1)[0][0] for client in clients] == [200] * 4
            assert engine.threads[-3:] == ["forward"] * 3


def test_replies_come_in_the_order_of_their_requests(service: Served) -> None:
    def request(number: int, image: bytes = JPEG) -> bytes:
        length = b"Content-Length: %d\r\n" % len(image)
        return HEAD + length + b"X-Frame-Id: %d\r\n\r\n" % number + image

    connection = dial(service)
    probe = b"GET /healthz HTTP/1.1\r\nHost: localhost\r\n\r\n"
    connection.sendall(request(1) + request(2) + probe + request(3, b"no image") + request(4))
    found = read(connection, 5)
    assert [status for status, _ in found] == [200, 200, 200, 422, 200]
    ids = [content.get("frame_id") for _, content in found]
    assert ids == ["1", "2", None, None, "4"]
    assert found[2][1] == {"status": "alive"}
    connection.sendall(request(5))
    assert read(connection, 1)[0][1]["frame_id"] == "5"


def test_a_body_may_arrive_in_parts_and_in_chunks(service: Served) -> None:
    connection = dial(service)
    for at in range(0, len(WHOLE), 1000):
        if at:
            service.wait_received(at)
        connection.sendall(WHOLE[at : at + 1000])
    pieces = read(connection, 1)[0]
    connection.sendall(HEAD + b"Transfer-Encoding: chunked\r\n\r\n")
    for at in range(0, len(JPEG), 999):
        part = JPEG[at : at + 999]
        connection.sendall(b"%x\r\n%b\r\n" % (len(part), part))
    connection.sendall(b"0\r\n\r\n")
    chunks = read(connection, 1)[0]
    connection.sendall(WHOLE.replace(b"Host", b"Expect: 100-continue\r\nHost", 1))
    assert connection.recv(25) == b"HTTP/1.1 100 Continue\r\n\r\n"
    expected = read(connection, 1)[0]
    for status, content in (pieces, chunks, expected):
        assert status == 200
        assert content["distances_m"] == pieces[1]["distances_m"]


def test_a_reply_says_that_the_connection_will_be_closed(service: Served) -> None:
    connection = dial(service)
    connection.sendall(WHOLE.replace(b"Host", b"Connection: close\r\nHost", 1))
    head = read_rest(connection).partition(b"\r\n\r\n")[0].lower()
    assert head.startswith(b"http/1.1 200 ok\r\n")
    for name in (b"date", b"x-request-id", b"content-type", b"content-length", b"connection"):
        assert head.count(b"\r\n%b: " % name) == 1


def test_a_client_that_reads_no_replies_is_read_no_more(service: Served) -> None:
    """The bytes that the client can send are limited to the system's buffers and one read."""
    for option in (socket.SO_SNDBUF, socket.SO_RCVBUF):
        service.listener.setsockopt(socket.SOL_SOCKET, option, 1 << 16)
    client = dial(service)
    client.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 16)
    client.setblocking(False)
    pad = b"X-Pad: " + b"x" * 7000  # so one read of 128 KiB has less than MAX_AT_ONCE
    request = b"POST /features HTTP/1.1\r\nHost: localhost\r\n%b\r\nContent-Length: 0\r\n\r\n" % pad
    until(lambda: len(service.server.server_state.connections) == 1)
    (connection,) = service.server.server_state.connections
    assert isinstance(connection, DirectProtocol)
    rest = b""

    def send_until_paused() -> bool:
        nonlocal rest
        with contextlib.suppress(BlockingIOError):
            for _ in range(50):
                rest = rest or request
                rest = rest[client.send(rest) :]
        return connection.flow.write_paused

    until(send_until_paused)
    until(lambda: connection.flow.read_paused)
    sent = 0
    with contextlib.suppress(BlockingIOError):
        while sent < 32 << 20:
            sent += client.send(request)
    assert sent < 32 << 20
    assert service.post(JPEG).status == 200
    assert connection.flow.read_paused
    client.close()


def test_a_connection_without_requests_is_closed_after_its_time() -> None:
    clock, engine = Clock(), constant_engine()
    with serving(engine, limits=Limits(idle_s=30.0), clock=clock) as service:
        connection = dial(service)
        for _ in range(3):
            connection.sendall(WHOLE)
            assert read(connection, 1)[0][0] == 200
            clock.now_s += 29.0
        service.wait_for_tick()
        connection.settimeout(0)
        with pytest.raises(BlockingIOError):  # the connection is still open
            connection.recv(1)
        connection.settimeout(PATIENCE_S)
        clock.now_s += 1.1
        assert connection.recv(1) == b""
    with serving(engine, limits=Limits(idle_s=0.1)) as service:  # with the real clock
        connection = dial(service)
        connection.sendall(WHOLE)
        assert read(connection, 1)[0][0] == 200
        assert connection.recv(1) == b""


def test_requests_of_a_proxy_count_for_the_client_it_names(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(rate_limit, "time", SimpleNamespace(monotonic=Clock()))
    with serving(limits=Limits(rate=2.0)) as service:
        for _ in range(9):
            assert service.post(JPEG).status == 200  # this machine has no limit
        statuses = [service.post(JPEG, X_Forwarded_For="10.1.2.3").status for _ in range(3)]
        assert statuses == [200, 200, 429]


def test_an_endless_body_is_refused_once(service: Served) -> None:
    connection = dial(service)
    connection.sendall(HEAD + b"Transfer-Encoding: chunked\r\n\r\n")
    piece = b"%x\r\n%b\r\n" % (1 << 20, bytes(1 << 20))
    for _ in range(MAX_BODY_BYTES // (1 << 20) + 2):
        connection.sendall(piece)
    connection.sendall(b"0\r\n\r\n" + WHOLE)
    assert [status for status, _ in read(connection, 2)] == [413, 200]


def test_requests_leave_nothing_for_the_garbage_collector(engine: FakeEngine) -> None:
    with serving(engine, limits=Limits(queue=1)) as served:
        served.post(JPEG)
        statuses: list[int] = []

        def ask() -> None:
            statuses.extend(served.post(body).status for body in (JPEG, b"text", JPEG))
            statuses.append(served.post(JPEG, X_Deadline_Ms="x").status)

        left = types_in_cycles(ask)
    assert statuses == [200, 422, 200, 422]
    assert not [kind for kind in left if kind.__module__.partition(".")[0] in ("serve", "mtlnet")]
