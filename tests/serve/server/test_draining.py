"""A worker stops: the requests that its clients have sent are answered, and no answer is lost."""

import logging
import socket
import time
from concurrent.futures import ThreadPoolExecutor

import pytest
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

from serve.server import guard, worker_server
from tests.serve.attacks.conftest import Target, read_head, read_reply
from tests.serve.conftest import JPEG, PATIENCE_S, FakeEngine, Gate, Served, serving, until


def stop(service: Served) -> None:
    """Begin to stop the service; returns once it drains its connections."""
    service.server.should_exit = True
    until(lambda: service.server.guard.draining)


def dial(service: Served) -> socket.socket:
    """The only connection of the service, which has accepted it."""
    connection = Target(service.port).dial()
    until(lambda: len(service.server.server_state.connections) == 1)
    return connection


def read_all(connection: socket.socket) -> bytes:
    """All bytes until the service ends the connection; raises ConnectionResetError on a reset."""
    return b"".join(iter(lambda: connection.recv(1 << 16), b""))


def test_requests_under_way_are_answered_and_pipelined_ones_lose_no_reply(
    engine: FakeEngine,
) -> None:
    with serving(engine) as service:
        target = Target(service.port)
        request = target.post(JPEG)
        half, many, new = (target.dial() for _ in range(3))
        many.sendall(target.ask())
        read_reply(many)
        half.sendall(request[:-100])
        new.sendall(b"GET /hea")
        until(lambda: len(service.server.server_state.connections) == 3)
        stop(service)
        many.sendall(request * 8)  # idle until now; only the first gets a reply
        half.sendall(request[-100:])
        new.sendall(b"lthz HTTP/1.1\r\nHost: localhost\r\n\r\n")
        for connection in (half, many, new):
            with connection:
                reply = read_all(connection)
            assert (reply[:12], reply.count(b"HTTP/1.1")) == (b"HTTP/1.1 200", 1)
            assert b"\r\nconnection: close\r\n" in reply


def test_a_reply_that_was_begun_is_the_last_one_and_later_bytes_do_not_reset_it() -> None:
    gate = Gate()
    with serving(gate.engine) as service:
        target = Target(service.port)
        connection = target.dial()
        connection.sendall(target.post(JPEG))
        until(gate.busy.is_set)
        stop(service)
        gate.open.set()
        with connection:
            assert read_head(connection).startswith(b"HTTP/1.1 200")
            connection.sendall(target.post(JPEG) * 4)  # a close with unread bytes would reset
            read_all(connection)


@pytest.mark.parametrize("path", ["/features", "/v2/models/track/infer"])
@pytest.mark.parametrize("stops", [True, False])
def test_a_refusal_before_the_end_of_a_slow_body_is_not_lost(
    engine: FakeEngine, monkeypatch: pytest.MonkeyPatch, path: str, *, stops: bool
) -> None:
    monkeypatch.setattr(guard, "LINGER_S", 0.02)
    monkeypatch.setattr(worker_server, "LAST_S", 0.02)
    with serving(engine) as service:
        target = Target(service.port)
        headers = {} if stops else {"Connection": "close"}
        request = target.post(bytes(80_000), path, **{"Content_Encoding": "gzip", **headers})
        connection = dial(service)
        if stops:
            stop(service)
        with connection:
            for start in range(0, len(request), 20_000):
                connection.sendall(request[start : start + 20_000])
                time.sleep(0.1)
            reply = read_all(connection)
        assert (reply[:12], reply.count(b"HTTP/1.1")) == (b"HTTP/1.1 415", 1)
        assert b"connection: close" in reply.lower()


def test_requests_behind_a_refusal_that_ends_the_connection_are_dropped(
    engine: FakeEngine, caplog: pytest.LogCaptureFixture
) -> None:
    with caplog.at_level(logging.ERROR), serving(engine) as service:
        target = Target(service.port)
        connection = dial(service)
        stop(service)
        connection.sendall(target.post(JPEG, Content_Encoding="gzip") * 3)
        with connection:
            assert read_all(connection).count(b"HTTP/1.1 415") == 1
    assert not caplog.records


def test_what_is_not_complete_in_time_is_refused(
    engine: FakeEngine, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(worker_server, "GRACE_S", 0.1)
    with serving(engine) as service:
        target = Target(service.port)
        connection = target.dial()
        connection.sendall(target.post(JPEG)[:-1])
        service.wait_received(len(target.post(JPEG)) - 1)
        service.server.should_exit = True
        with connection:
            reply = read_all(connection)
        assert reply.startswith(b"HTTP/1.1 503")
        assert b"the service stops or restarts" in reply


def test_a_websocket_gets_the_answers_that_it_is_owed_then_the_reason() -> None:
    gate = Gate()
    with serving(gate.engine) as service, ThreadPoolExecutor(1) as pool:
        with connect(f"ws://127.0.0.1:{service.port}/stream", compression=None) as websocket:
            websocket.send(JPEG)
            until(gate.busy.is_set)
            stop(service)
            for _ in range(8):  # the service does not read these
                websocket.send(JPEG)
            answer = pool.submit(websocket.recv, PATIENCE_S)
            gate.open.set()
            assert '"angle_rad"' in str(answer.result())
            with pytest.raises(ConnectionClosed) as closed:
                websocket.recv(PATIENCE_S)
        assert closed.value.rcvd is not None
        assert closed.value.rcvd.code == 1012


def test_no_websocket_is_opened_and_idle_connections_are_closed(
    engine: FakeEngine, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(guard, "DRAIN_S", PATIENCE_S)
    monkeypatch.setattr(worker_server, "GRACE_S", PATIENCE_S)
    with serving(engine) as service:
        target = Target(service.port)
        connections = [target.dial() for _ in range(2)]
        for connection in connections:
            connection.sendall(target.ask())
            read_reply(connection)
        stop(service)
        with connections[0] as connection:
            connection.sendall(target.handshake())
            assert b"HTTP/1.1 503" in read_all(connection)
        monkeypatch.setattr(guard, "DRAIN_S", 0.0)
        with connections[1] as connection:
            assert b"HTTP/1.1" not in read_all(connection)
