"""Attacks with HTTP connections: each is answered or ended, and keeps no memory."""

import gc
import select
import socket
import time
from collections.abc import Callable

import pytest

from serve.config import Limits
from serve.server.connection import MAX_AT_ONCE, MAX_PIPELINED, WORK_S
from serve.server.fast_path import DirectProtocol
from serve.server.websocket import GuardedWebSocket
from tests.serve.attacks import attacks, websockets
from tests.serve.attacks.conftest import (
    Target,
    close,
    open_count,
    read_reply,
    read_rest,
    send_all,
    status_of,
    uncollected,
)
from tests.serve.conftest import JPEG, PATIENCE_S, Clock, Gate, Served, serving, until

MB = 1 << 20
TOKEN = "a-token-of-some-length"


@pytest.mark.parametrize("attack", [attacks.long_upgrades, attacks.crowded_upgrades])
def test_refused_upgrades_are_answered_and_swept(
    attack: Callable[[Target, int], list[socket.socket]],
) -> None:
    with serving(limits=Limits(connections=8)) as service:
        connections = attack(Target(service.port), 8)
        for connection in connections:
            received = read_rest(connection)
            assert status_of(received) == 431
            assert b"/problems/headers-too-large" in received
        until(lambda: len(service.server.guard.refused) == 8)
        assert service.ask("GET", "/healthz").status == 200
        close(connections)
        until(lambda: open_count(service) == 1)


def test_an_invalid_websocket_handshake_is_answered(target: Target) -> None:
    for sent, status in (
        (target.handshake(Content_Length="5") + b"hello", 400),
        (target.handshake(Content_Length="5"), 400),
        (target.handshake(Transfer_Encoding="chunked"), 400),
        (target.handshake().replace(b"AAAA==", b"==="), 400),
        (target.handshake().replace(b"GET", b"POST"), 405),
    ):
        with target.dial() as connection:
            connection.sendall(sent)
            assert status_of(read_rest(connection)) == status


def test_bytes_sent_with_the_handshake_close_the_connection(target: Target) -> None:
    for connection in websockets.frames_before_the_handshake(target, 4):
        assert status_of(read_rest(connection)) == 400
    with target.dial() as connection:
        connection.sendall(target.post(JPEG) + target.handshake())
        received = read_rest(connection)
        assert status_of(received) == 200  # the reply to the image
        assert b"101" not in received.partition(b"\r\n")[2]


def test_an_answer_that_nobody_reads_has_a_deadline() -> None:
    """Pipelined requests wait until the client reads the earlier replies."""
    clock = Clock()
    with serving(limits=Limits(idle_s=30.0), clock=clock) as service:
        for option in (socket.SO_SNDBUF, socket.SO_RCVBUF):
            service.listener.setsockopt(socket.SOL_SOCKET, option, 1 << 14)
        target = Target(service.port)
        connection = target.dial()
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 14)
        until(lambda: open_count(service) == 1)
        (found,) = service.server.server_state.connections
        assert isinstance(found, DirectProtocol)

        state, sent = service.server.server_state, 0
        while not found.flow.write_paused:
            connection.sendall(target.ask(path="/openapi.json"))
            sent += 1
            until(lambda: state.total_requests == sent or found.flow.write_paused)  # noqa: B023
        connection.sendall(target.ask())
        until(lambda: found in service.server.guard.working)
        service.wait_for_tick()
        assert open_count(service) == 1
        clock.now_s += 30.1
        until(lambda: open_count(service) == 0)


def test_an_answer_that_never_comes_has_a_deadline() -> None:
    clock, gate = Clock(), Gate()
    with serving(gate.engine, clock=clock) as service, Target(service.port).dial() as connection:
        connection.sendall(Target(service.port).post(JPEG))
        assert gate.busy.wait(PATIENCE_S)
        clock.now_s += WORK_S - 1
        service.wait_for_tick()
        assert open_count(service) == 1
        clock.now_s += 2
        assert read_rest(connection) == b""
        gate.open.set()


def test_idle_connections_lock_nobody_out(service: Served, target: Target) -> None:
    connections = attacks.idle_connections(target)
    until(lambda: open_count(service) == 256)
    for _ in range(5):
        client = Served(service.port)
        assert client.ask("GET", "/healthz").status == 200
        assert client.post(JPEG).status == 200
        assert open_count(service) <= 257
    close(connections)


@pytest.mark.parametrize(
    "attack",
    [attacks.silent_connections, attacks.slow_headers, attacks.slow_bodies, attacks.churn],
)
def test_more_connections_than_the_service_takes_lock_nobody_out(
    service: Served, attack: attacks.Attack
) -> None:
    connections = attack(Target(service.port))
    time.sleep(0.11)
    assert service.post(JPEG).status == 200
    assert open_count(service) <= 258
    assert service.post(JPEG).status == 200
    close(connections)


@pytest.mark.parametrize("attack", [attacks.long_upgrades, attacks.crowded_upgrades])
def test_a_refused_handshake_leaves_no_reference_cycle(
    service: Served, target: Target, attack: Callable[[Target, int], list[socket.socket]]
) -> None:
    service.post(JPEG)
    with uncollected():
        close(attack(target, 10))
        until(lambda: open_count(service) == 1)
        kinds = (GuardedWebSocket, DirectProtocol)
        # One remaining connection is that of `service.post`.
        until(lambda: sum(isinstance(o, kinds) for o in gc.get_objects()) <= 1)


def test_pipelined_requests_are_bounded(service: Served, target: Target) -> None:
    with target.dial() as connection:
        connection.sendall(target.post(b"", Content_Type="text/plain") * 4 * MAX_AT_ONCE)
        received = read_rest(connection)
        assert 1 <= received.count(b"HTTP/1.1 415") <= 2 * MAX_AT_ONCE
        assert received.count(b"HTTP/1.1 429") == 1
    with target.dial() as connection:
        connection.sendall(target.ask() * 4 * MAX_PIPELINED)
        received = read_rest(connection)
        assert received.count(b"HTTP/1.1 200") == 1  # the request in progress
        assert b"connection: close" in received
    with target.dial() as connection:
        connection.sendall(target.ask() * MAX_PIPELINED)
        assert [read_reply(connection)[0] for _ in range(MAX_PIPELINED)] == [200] * MAX_PIPELINED
    assert service.post(JPEG).status == 200


def test_an_offer_of_http_2_is_ignored(service: Served, target: Target) -> None:
    offer = {"Connection": "Upgrade, HTTP2-Settings", "Upgrade": "h2c", "HTTP2_Settings": "AAMA"}
    expected = service.post(JPEG).content["distances_m"]
    with target.dial() as connection:
        for _ in range(2):
            connection.sendall(target.post(JPEG, **offer))
            status, content = read_reply(connection)
            assert (status, content["distances_m"]) == (200, expected)
        connection.sendall(target.ask(**offer))
        assert read_reply(connection) == (200, {"status": "alive"})
        whole = target.post(b"", **offer, Content_Length="38", Content_Type="image/png")
        connection.sendall(whole)
        connection.sendall(b"GET /model HTTP/1.1\r\nHost: localhost\r\n\r\n"[:38])
        assert read_reply(connection)[0] == 422
        connection.sendall(target.ask())
        assert read_reply(connection) == (200, {"status": "alive"})


def test_the_second_segment_of_an_offer_is_no_request_and_close_is_kept(target: Target) -> None:
    for connection in attacks.h2c_in_two_segments(target, 4):
        assert read_reply(connection)[0] == 422
        connection.settimeout(0.3)
        with pytest.raises(TimeoutError):
            connection.recv(1)
    with target.dial() as connection:
        connection.sendall(target.ask(Connection="close, upgrade", Upgrade="h2c"))
        assert b"connection: close" in read_rest(connection)


@pytest.mark.parametrize("attack", [attacks.tunnels, attacks.upgrade_floods])
def test_upgrades_that_the_service_does_not_know_end_the_connection(
    service: Served, target: Target, attack: Callable[[Target, int], list[socket.socket]]
) -> None:
    for connection in attack(target, 3):
        connection.settimeout(PATIENCE_S)
        assert read_rest(connection).startswith(b"HTTP/1.1 ")
    assert service.post(JPEG).status == 200


def test_a_connection_that_ends_while_others_begin_is_not_waited_for(service: Served) -> None:
    """The service never exceeds its limit, even while ended connections are still closing."""
    target = Target(service.port)
    connections = []
    for _ in range(300):
        connection = target.dial()
        send_all(connection, target.ask())
        connections.append(connection)
        assert open_count(service) <= 260
    ended, _, _ = select.select(connections, [], [], PATIENCE_S)
    assert ended
    close(connections)
