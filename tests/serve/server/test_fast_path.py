"""Requests that go straight from the parser to the engine: who answers, and in which order."""

import gc
import json
import socket
import threading
import time
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from serve.config import MAX_BODY_BYTES, Limits
from serve.scheduling import frame_queue
from serve.scheduling.frame_queue import INLINE_AFTER
from tests.serve.conftest import FakeEngine, Served, jpeg, outputs, picture, serving, until

JPEG = jpeg(picture())
HEAD = b"POST /features HTTP/1.1\r\nHost: x\r\nContent-Type: image/jpeg\r\n"
QUICK_MS = 500.0  # longer than in earnest: a busy machine makes any frame slow
WHOLE = HEAD + b"Content-Length: %d\r\n\r\n" % len(JPEG) + JPEG


class Witness(FakeEngine):
    """An engine that remembers which thread each frame was answered by, and can be made slow."""

    def __init__(self) -> None:
        super().__init__(self._respond)
        self.threads: list[str] = []
        self.wait_s = 0.0

    def _respond(self, _image: NDArray[np.uint8]) -> NDArray[np.float32]:
        self.threads.append(threading.current_thread().name)
        time.sleep(self.wait_s)
        return outputs()


def read(connection: socket.socket, count: int) -> list[tuple[int, dict[str, Any]]]:
    """The next `count` replies: their status and content."""
    found: list[tuple[int, dict[str, Any]]] = []
    received = b""
    while len(found) < count:
        head, end, rest = received.partition(b"\r\n\r\n")
        length = int(head.lower().partition(b"content-length: ")[2].split(b"\r\n")[0]) if end else 0
        if end and len(rest) >= length:
            found.append((int(head.split()[1]), json.loads(rest[:length])))
            received = rest[length:]
            continue
        part = connection.recv(65536)
        assert part
        received += part
    return found


def dial(service: Served) -> socket.socket:
    connection = socket.create_connection(("127.0.0.1", service.port))
    connection.settimeout(60)
    return connection


def test_a_lone_frame_of_a_quick_engine_is_answered_by_the_event_loop(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(frame_queue, "INLINE_MAX_MS", QUICK_MS)
    engine = Witness()
    large = jpeg(picture(1120, 840))
    with serving(engine) as service:

        def ask(image: bytes = JPEG) -> str:
            assert service.post(image).status == 200
            return engine.threads[-1]

        def by_the_loop() -> bool:
            return ask() != "forward"

        assert [ask() for _ in range(INLINE_AFTER)] == ["forward"] * INLINE_AFTER
        until(by_the_loop)  # at once, unless a frame was slow after all
        assert ask(large) == "forward"
        until(by_the_loop)
        engine.wait_s = 1.1 * QUICK_MS / 1e3
        ask()
        assert [ask() for _ in range(3)] == ["forward"] * 3  # it was slow, and is trusted no more


def test_frames_that_come_together_are_left_to_the_thread(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(frame_queue, "INLINE_MAX_MS", QUICK_MS)
    engine = Witness()
    with serving(engine) as service:
        until(lambda: service.post(JPEG).status == 200 and engine.threads[-1] != "forward")
        engine.wait_s = 0.01
        clients = [dial(service) for _ in range(4)]
        for _ in range(10):
            for client in clients:
                client.sendall(WHOLE)
            assert [read(client, 1)[0][0] for client in clients] == [200] * 4
        assert engine.threads.count("forward") > INLINE_AFTER + 10


def test_replies_come_in_the_order_of_their_requests(service: Served) -> None:
    def request(number: int, image: bytes = JPEG) -> bytes:
        length = b"Content-Length: %d\r\n" % len(image)
        return HEAD + length + b"X-Frame-Id: %d\r\n\r\n" % number + image

    connection = dial(service)
    probe = b"GET /healthz HTTP/1.1\r\nHost: x\r\n\r\n"
    connection.sendall(request(1) + request(2) + probe + request(3, b"no image") + request(4))
    found = read(connection, 5)
    assert [status for status, _ in found] == [200, 200, 200, 422, 200]
    ids = [content.get("frame_id") for _, content in found]
    assert ids == ["1", "2", None, None, "4"]
    assert found[2][1] == {"status": "alive"}
    connection.sendall(request(5))
    assert read(connection, 1)[0][1]["frame_id"] == "5"


def test_a_body_may_come_in_pieces_and_in_chunks(service: Served) -> None:
    connection = dial(service)
    for at in range(0, len(WHOLE), 1000):
        connection.sendall(WHOLE[at : at + 1000])
        time.sleep(0.002)
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


def test_a_reply_says_when_the_connection_ends(service: Served) -> None:
    connection = dial(service)
    connection.sendall(WHOLE.replace(b"Host", b"Connection: close\r\nHost", 1))
    received = b""
    while part := connection.recv(65536):
        received += part
    head = received.partition(b"\r\n\r\n")[0].lower()
    assert head.startswith(b"http/1.1 200 ok\r\n")
    for name in (b"date", b"x-request-id", b"content-type", b"content-length", b"connection"):
        assert head.count(b"\r\n%b: " % name) == 1


def test_who_asks_and_never_reads_stops_being_heard(service: Served) -> None:
    """Refusals without end: what is unread stays within what the system and one piece hold."""
    deaf = dial(service)
    deaf.setblocking(False)
    request = b"POST /features HTTP/1.1\r\nHost: x\r\nContent-Length: 0\r\n\r\n" * 500
    sent, end = 0, time.monotonic() + 60
    silent_since = time.monotonic()
    while time.monotonic() < min(end, silent_since + 1.0):
        try:
            sent += deaf.send(request)
            silent_since = time.monotonic()
        except BlockingIOError:
            time.sleep(0.01)
    assert time.monotonic() < end
    assert sent < 32 << 20
    assert service.post(JPEG).status == 200


def test_a_connection_without_requests_is_closed_in_time() -> None:
    with serving(FakeEngine(lambda _image: outputs()), limits=Limits(idle_s=0.3)) as service:
        connection = dial(service)
        for _ in range(2):
            connection.sendall(WHOLE)
            assert read(connection, 1)[0][0] == 200
            time.sleep(0.05)
        begin = time.monotonic()
        assert connection.recv(1) == b""
        assert time.monotonic() - begin > 0.2


def test_a_proxy_names_the_client_whose_requests_are_counted() -> None:
    with serving(FakeEngine(lambda _image: outputs()), limits=Limits(rate=2.0)) as service:
        for _ in range(9):
            assert service.post(JPEG).status == 200  # this machine
        statuses = [service.post(JPEG, X_Forwarded_For="10.1.2.3").status for _ in range(3)]
        assert statuses == [200, 200, 429]


def test_a_body_without_end_is_refused_once(service: Served) -> None:
    connection = dial(service)
    connection.sendall(HEAD + b"Transfer-Encoding: chunked\r\n\r\n")
    piece = b"%x\r\n%b\r\n" % (1 << 20, bytes(1 << 20))
    for _ in range(MAX_BODY_BYTES // (1 << 20) + 2):
        connection.sendall(piece)
    connection.sendall(b"0\r\n\r\n" + WHOLE)
    assert [status for status, _ in read(connection, 2)] == [413, 200]


def test_requests_leave_nothing_for_the_garbage_collector(engine: FakeEngine) -> None:
    """It holds up all clients while it looks for cycles."""
    with serving(engine, limits=Limits(queue=1)) as served:
        served.post(JPEG)
        gc.collect()
        gc.disable()
        gc.set_debug(gc.DEBUG_SAVEALL)
        try:
            statuses = [served.post(body).status for body in (JPEG, b"text", JPEG)]
            statuses.append(served.post(JPEG, X_Deadline_Ms="x").status)
            gc.collect()
            left = [type(found) for found in gc.garbage]
        finally:
            gc.set_debug(0)
            gc.garbage.clear()
            gc.enable()
    assert statuses == [200, 422, 200, 422]
    assert not [kind for kind in left if kind.__module__.partition(".")[0] in ("serve", "mtlnet")]
