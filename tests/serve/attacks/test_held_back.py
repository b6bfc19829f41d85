"""Withheld bodies and messages: they are counted as they arrive, and are ended for small ones."""

import socket
import time
from collections.abc import Callable

import pytest

from serve.config import Limits
from serve.scheduling.body_budget import BodyBudget
from serve.server.guard import EVICTABLE_S
from tests.serve.attacks import costs
from tests.serve.attacks.conftest import (
    BINARY,
    CONTINUATION,
    Target,
    frame,
    read_close,
    read_head,
    send_all,
)
from tests.serve.conftest import INFER, JPEG, FakeEngine, serving, until

MIB = 1 << 20


def settle(bodies: BodyBudget) -> None:
    """Wait until no more bytes of the withheld bodies arrive; then they count as slow."""
    held = -1
    while held != bodies.held or held < 3 * MIB:
        held = bodies.held
        time.sleep(3 * EVICTABLE_S)


@pytest.mark.parametrize("attack", [costs.large_bodies, costs.half_messages])
def test_bodies_that_are_held_back_give_way_to_small_ones(
    engine: FakeEngine, attack: Callable[[Target, int], list[socket.socket]]
) -> None:
    """This holds for all paths; together the bodies never exceed the budget."""
    with serving(engine, limits=Limits(body_mib=8)) as service:
        bodies = service.app.bodies
        connections = attack(Target(service.port), 12)
        settle(bodies)
        for _ in range(5):
            assert service.post(JPEG).status == 200
            assert bodies.held <= 8 * MIB
            infer = service.ask("POST", INFER, b"{}", {"Content-Type": "application/json"})
            assert infer.status in (400, 422)
        for connection in connections:
            connection.close()
        until(lambda: bodies.held == 0)


def test_a_client_that_is_closed_for_another_gets_a_problem(engine: FakeEngine) -> None:
    with serving(engine, limits=Limits(body_mib=4)) as service:
        (slow,) = costs.large_bodies(Target(service.port), 1)
        settle(service.app.bodies)
        assert service.post(JPEG).status == 200
        slow.settimeout(30.0)
        assert read_head(slow).startswith(b"HTTP/1.1 503")
        slow.close()
        until(lambda: service.app.bodies.held == 0)


def test_a_message_of_a_websocket_counts_as_it_arrives(engine: FakeEngine) -> None:
    with serving(engine, limits=Limits(body_mib=8)) as service:
        bodies, target = service.app.bodies, Target(service.port)
        with target.open_websocket() as connection:
            connection.sendall(frame(BINARY, bytes(MIB), fin=False))
            connection.sendall(frame(CONTINUATION, bytes(MIB))[:-1])
            until(lambda: bodies.held >= 2 * MIB - 1)
            assert bodies.held < 2 * MIB + 64
            connection.sendall(b"\0")
            until(lambda: bodies.held == 0)
            connection.sendall(frame(BINARY, bytes(3 * MIB))[:-1])
            until(lambda: bodies.held > 2 * MIB)
            with target.open_websocket() as other, target.open_websocket() as third:
                other.sendall(frame(BINARY, bytes(3 * MIB))[:-1])
                until(lambda: bodies.held > 5 * MIB)
                send_all(third, frame(BINARY, bytes(4 * MIB - 64))[:-1])
                code, reason = read_close(third)
                assert code == 1013
                assert "8 MiB" in reason
            page = service.app.metrics.page(time.monotonic(), {})
            assert 'closed_connections_total{problem="overloaded"} 1\n' in page
        until(lambda: bodies.held == 0)
