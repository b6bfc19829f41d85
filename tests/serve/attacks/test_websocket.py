"""Attacks with WebSockets: queues have limits, and the close frame has the reason."""

import asyncio
import gc
import logging
import socket
import threading
import time
from typing import Any

import pytest

from serve.config import Limits
from serve.server.guard import EVICTABLE_S
from serve.server.websocket import GuardedWebSocket
from tests.serve.attacks import attacks, websockets
from tests.serve.attacks.conftest import (
    BINARY,
    CONTINUATION,
    PING,
    TEXT,
    Target,
    close,
    frame,
    read_close,
    read_rest,
    resident_mb,
    send_all,
    uncollected,
)
from tests.serve.conftest import JPEG, PATIENCE_S, Clock, Gate, Served, serving, until

POLICY, INVALID, TOO_BIG, TRY_LATER = 1008, 1007, 1009, 1013


def streams(service: Served) -> list[GuardedWebSocket]:
    """The open WebSockets of a service."""
    return [s for s in list(service.server.guard.streams) if isinstance(s, GuardedWebSocket)]


@pytest.mark.parametrize(
    "attack",
    [
        websockets.unread_pings,
        websockets.large_unread_pings,
        websockets.empty_fragments,
        websockets.small_messages,
        websockets.text_floods,
    ],
)
def test_small_frames_are_bounded(
    service: Served, target: Target, attack: attacks.Attack, caplog: pytest.LogCaptureFixture
) -> None:
    before = resident_mb()
    started_s = time.monotonic()
    (connection,) = attack(target)
    assert service.post(JPEG).status == 200
    assert resident_mb() - before < 30
    code, reason = read_close(connection)
    assert code == POLICY
    assert "small frames" in reason
    page = service.app.metrics.page(time.monotonic(), {})
    assert 'closed_connections_total{problem="rate-limited"} 1\n' in page
    assert time.monotonic() - started_s < PATIENCE_S
    connection.close()
    gc.collect()
    assert not [r for r in caplog.records if r.levelno >= logging.WARNING]


def test_no_part_received_holds_the_event_loop(service: Served, target: Target) -> None:
    """256 KiB of empty fragments once blocked the loop for 1 s; other clients must wait less."""
    for _ in range(3):
        connections = [target.open_websocket() for _ in range(3)]
        for connection in connections:
            send_all(connection, frame(CONTINUATION, fin=False) * 40_000)
        started_s = time.process_time()
        assert service.post(JPEG).status == 200
        assert time.process_time() - started_s < 0.5
        for connection in connections:
            connection.close()


def test_pings_below_the_rate_are_answered(service: Served, target: Target) -> None:
    with target.open_websocket() as connection:
        for number in range(400):
            connection.sendall(frame(PING, b"%d" % number))
        received = b""
        while b"399" not in received:
            received += connection.recv(65536)
        connection.sendall(frame(BINARY, JPEG))
        assert b"distances_m" in connection.recv(65536)


def test_a_message_in_fragments_is_put_together(target: Target) -> None:
    with target.open_websocket() as connection:
        parts = [JPEG[at : at + 1000] for at in range(0, len(JPEG), 1000)]
        sent = frame(BINARY, parts[0], fin=False)
        sent += b"".join(frame(CONTINUATION, part, fin=False) for part in parts[1:])
        connection.sendall(sent + frame(CONTINUATION))
        assert b"distances_m" in connection.recv(65536)


def test_pings_that_nobody_reads_the_answers_of_take_no_memory() -> None:
    """A fast clock disables the rate limit for small frames."""
    now_s = 0.0

    def clock() -> float:
        nonlocal now_s
        now_s += 1.0
        return now_s

    limits = Limits(head_s=1e9, body_s=1e9, idle_s=1e9)
    with serving(limits=limits, clock=clock) as service:
        before = resident_mb()
        (connection,) = websockets.unread_pings(Target(service.port), megabytes=32)
        assert resident_mb() - before < 30
        assert service.post(JPEG).status == 200
        connection.close()


def test_a_message_and_the_reading_of_answers_have_deadlines() -> None:
    clock = Clock()
    gate = Gate()
    limits = Limits(body_s=10.0, idle_s=30.0)
    with serving(gate.engine, limits=limits, clock=clock) as service:
        target = Target(service.port)
        for option in (socket.SO_SNDBUF, socket.SO_RCVBUF):
            service.listener.setsockopt(socket.SOL_SOCKET, option, 1 << 14)
        half, fragment = target.open_websocket(), target.open_websocket()
        half.sendall(frame(BINARY, JPEG)[:-1])
        fragment.sendall(frame(BINARY, JPEG, fin=False))
        until(lambda: sum(s._message_end_s < 1e9 for s in streams(service)) == 2)
        clock.now_s += 9.0
        service.wait_for_tick()
        assert len(service.server.guard.streams) == 2
        clock.now_s += 1.1
        for connection in (half, fragment):
            code, reason = read_close(connection)
            assert (code, reason) == (POLICY, "a message took more than 10 s")
        unread = target.open_websocket()
        unread.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 14)
        unread.settimeout(0.2)
        (found,) = streams(service)

        def flood() -> bool:
            send_all(unread, frame(BINARY, b"no image" * 256), 100)
            return not found.writable.is_set()

        until(flood)
        clock.now_s += 30.1
        until(lambda: not service.server.guard.streams)
        gate.open.set()


def test_a_handshake_has_a_deadline(monkeypatch: pytest.MonkeyPatch) -> None:
    """The application does not answer the handshake; only a fault of the service causes this."""
    clock = Clock()
    with serving(clock=clock) as service:

        async def never(_scope: object, receive: object, _send: object) -> None:
            import asyncio

            await asyncio.sleep(PATIENCE_S)

        monkeypatch.setattr(service.app, "_stream", never)
        target = Target(service.port)
        with target.dial() as connection:
            connection.sendall(target.handshake())
            until(lambda: bool(service.server.guard.streams))
            clock.now_s += 5.1
            assert read_rest(connection) == b""
            for task in list(service.server.server_state.tasks):
                task.get_loop().call_soon_threadsafe(task.cancel)


def test_deep_and_broken_texts_are_refused(service: Served, target: Target) -> None:
    with target.open_websocket() as connection:
        for text in (b"[" * 900, b"[" * 4000, b'"\\ud800"', b'{"deadline_ms": 1e999}'):
            connection.sendall(frame(TEXT, text) + frame(BINARY, JPEG))
            assert b"/problems/invalid-request" in connection.recv(65536)
        connection.sendall(frame(TEXT, b'{"frame_id": "7"}') + frame(BINARY, JPEG))
        assert b'"frame_id":"7"' in connection.recv(65536)
    for connection in websockets.broken_texts(target, 3):
        assert read_close(connection) == (INVALID, "the text is not UTF-8")
    assert service.post(JPEG).status == 200


def test_a_long_text_is_refused_before_it_is_decoded(service: Served, target: Target) -> None:
    whole = frame(TEXT, b"x" * 5000)
    parts = frame(TEXT, b"x" * 4000, fin=False) + frame(CONTINUATION, b"x" * 1000, fin=False)
    for sent in (whole, parts):
        with target.open_websocket() as connection:
            connection.sendall(sent)
            assert read_close(connection) == (TOO_BIG, "a text has at most 4096 bytes")
    assert service.post(JPEG).status == 200


def test_a_message_counts_in_the_budget_until_the_service_takes_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    size, taken = 2 << 20, threading.Event()
    with serving() as service:
        config = service.server.config  # a ping detects the disconnect of a client that is not read
        config.ws_ping_interval = config.ws_ping_timeout = 0.5

        async def busy(_scope: object, receive: Any, send: Any) -> None:
            await receive()
            await send({"type": "websocket.accept"})
            for _ in range(2):
                while not taken.is_set():
                    await asyncio.sleep(0.01)
                taken.clear()
                await receive()

        monkeypatch.setattr(service.app, "_stream", busy)
        bodies = service.server.guard.bodies
        assert bodies is not None
        target = Target(service.port)
        with target.open_websocket() as connection:
            connection.sendall(frame(BINARY, bytes(size)))
            until(lambda: bodies.held == size)
            taken.set()
            until(lambda: bodies.held == 0)
            connection.sendall(frame(BINARY, bytes(size)))
            until(lambda: bodies.held == size)
        until(lambda: bodies.held == 0)  # the client has disconnected
        taken.set()


def test_leaving_a_busy_websocket_writes_nothing_to_the_log(
    caplog: pytest.LogCaptureFixture,
) -> None:
    gate = Gate()
    with caplog.at_level(logging.WARNING), serving(gate.engine, limits=Limits(queue=4)) as service:
        target = Target(service.port)
        for _ in range(3):
            websockets.left_websockets(target, 8)
            connections = [target.open_websocket() for _ in range(8)]
            for connection in connections:  # closed while the frames wait
                send_all(connection, frame(BINARY, JPEG) * 6 + frame(TEXT, b"\xff"))
            until(lambda: not service.server.guard.streams)
            for connection in connections:
                connection.close()
        gate.open.set()
        until(lambda: not service.server.server_state.connections)
        until(lambda: not service.server.server_state.tasks)
        until(lambda: service.post(JPEG).status == 200)  # after the frames of the closed ones
        gc.collect()
    assert [record.getMessage() for record in caplog.records] == []


def test_refused_handshakes_write_one_line_a_second_to_the_log(
    service: Served, target: Target, caplog: pytest.LogCaptureFixture
) -> None:
    with caplog.at_level(logging.INFO):
        for _ in range(20):
            with target.dial() as connection:
                connection.sendall(target.handshake(X_Deadline_Ms="soon"))
                assert read_rest(connection).startswith(b"HTTP/1.1 422")
        until(lambda: not service.server.server_state.tasks)
    assert [record.name for record in caplog.records if record.levelno >= logging.WARNING] == []
    lines = [record for record in caplog.records if record.name == "serve.requests"]
    assert 1 <= len(lines) < 10


def test_websockets_without_messages_give_way() -> None:
    clock = Clock()
    with serving(limits=Limits(connections=3, idle_s=30.0), clock=clock) as service:
        target = Target(service.port)
        quiet, busy, other = (target.open_websocket() for _ in range(3))
        clock.now_s += 29.0
        busy.sendall(frame(BINARY, JPEG))
        assert b"distances_m" in busy.recv(65536)
        with target.dial() as refused:
            assert b"/problems/too-many-connections" in read_rest(refused)
        until(lambda: len(service.server.server_state.connections) == 3)
        clock.now_s += 1.1 + EVICTABLE_S
        assert service.post(JPEG).status == 200
        assert read_close(quiet)[0] == TRY_LATER
        busy.sendall(frame(BINARY, JPEG))
        assert b"distances_m" in busy.recv(65536)
        for connection in (quiet, busy, other):
            connection.close()


def test_leaving_in_the_middle_of_a_message_leaves_nothing(service: Served, target: Target) -> None:
    service.post(JPEG)
    with uncollected():
        for _ in range(4):
            connections = websockets.half_frames(target, 16)
            until(lambda: sum(s._message_end_s < 1e9 for s in streams(service)) == 16)
            close(connections)
            until(lambda: not service.server.guard.streams)


def test_a_websocket_that_is_not_read_keeps_no_images(service: Served, target: Target) -> None:
    before = resident_mb()
    connections = [target.open_websocket() for _ in range(16)]
    for connection in connections:
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 14)
        connection.settimeout(0.2)
        send_all(connection, frame(BINARY, b"no image" * (1 << 15)), 40)
    assert resident_mb() - before < 60
    for connection in connections:
        connection.close()
    assert service.post(JPEG).status == 200
