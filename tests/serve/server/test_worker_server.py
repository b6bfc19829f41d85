"""The choice of the worker that accepts a connection, among the workers on one port."""

import threading
import time

import pytest

from serve import shared_memory
from serve.config import Limits
from serve.server import worker_server
from serve.server.worker_server import WorkerServer
from serve.shared_memory import WorkerPeers
from tests.serve.conftest import (
    JPEG,
    PATIENCE_S,
    Served,
    assert_problem,
    constant_engine,
    serving,
    until,
)


def make_clients(port: int) -> list[Served]:
    return [Served(port) for _ in range(8)]


def ask_each(clients: list[Served]) -> list[int]:
    """The status of a request of each client; all connections stay open."""
    return [client.post(JPEG).status for client in clients]


def test_a_worker_that_warms_up_leaves_connections_to_one_that_is_ready(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    memory = shared_memory.create_shared_memory(blocks=2)
    ours, others = constant_engine(), constant_engine()
    warm = threading.Event()
    with (
        serving(ours, shared=memory) as one,
        serving(
            others, lambda _engine: warm.wait(PATIENCE_S), shared=memory, block=1, beside=one
        ) as two,
    ):
        until(lambda: one.app.frame_queue.ready)
        until(WorkerPeers(memory, 1).other_is_ready)
        early, late = make_clients(one.port), make_clients(one.port)
        assert ask_each(early) == [200] * 8
        assert not others.images
        warm.set()
        until(lambda: two.app.frame_queue.ready)
        # The worker with more connections now yields for longer than the other worker can need.
        monkeypatch.setattr(worker_server, "YIELD_S", PATIENCE_S)
        assert ask_each(late) == [200] * 8
        assert len(others.images) == 8


def test_while_no_worker_is_ready_requests_are_refused() -> None:
    memory = shared_memory.create_shared_memory(blocks=2)
    engine = constant_engine()
    warm = threading.Event()
    with (
        serving(engine, lambda _engine: warm.wait(PATIENCE_S), shared=memory) as one,
        serving(engine, lambda _engine: warm.wait(PATIENCE_S), shared=memory, block=1, beside=one),
    ):
        assert ask_each(make_clients(one.port)) == [503] * 8
        warm.set()


def test_a_worker_with_the_most_connections_ends_idle_ones_for_another(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    memory = shared_memory.create_shared_memory(blocks=2)
    limits = Limits(connections=4)
    with serving(limits=limits, shared=memory) as one:
        idle = [Served(one.port) for _ in range(4)]
        assert ask_each(idle) == [200] * 4
        with serving(limits=limits, shared=memory, block=1, beside=one) as two:
            until(lambda: WorkerPeers(memory, 1).other_connections() == [4])
            monkeypatch.setattr(worker_server, "YIELD_S", PATIENCE_S)  # worker one yields to two
            refused = Served(two.port).post(JPEG)  # two accepts it, and has no connection to end
            assert_problem(refused, 503, "too-many-connections")
            until(lambda: WorkerPeers(memory, 1).other_connections() == [3])
            assert Served(two.port).post(JPEG).status == 200
            assert ask_each(idle[1:]) == [200] * 3


def test_refused_clients_end_one_idle_connection_at_a_time() -> None:
    memory = shared_memory.create_shared_memory(blocks=2)
    with serving(limits=Limits(connections=4), shared=memory) as one:
        idle = [Served(one.port) for _ in range(4)]
        assert ask_each(idle) == [200] * 4
        other = WorkerPeers(memory, 1)
        until(lambda: other.other_connections() == [4])
        for _ in range(3):
            other.ask_for_room(least=1)
        until(lambda: other.other_connections() == [3])
        other.ask_for_room(least=1)  # now there is room
        one.wait_for_tick()
        assert other.other_connections() == [3]
        assert ask_each(idle[1:]) == [200] * 3


def test_room_is_asked_of_the_worker_with_the_most_connections_once() -> None:
    memory = shared_memory.create_shared_memory(blocks=3)
    few, many, full = (WorkerPeers(memory, block) for block in range(3))
    for peers, connections in ((few, 1), (many, 5), (full, 3)):
        peers.publish(connections, ready=True)
    full.ask_for_room(least=4)
    few.ask_for_room(least=2)
    assert (few.room_asked(), many.room_asked()) == (None, 2)
    few.publish(9, ready=True)
    assert (few.room_asked(), many.room_asked()) == (None, None)
    assert WorkerPeers(memory, 0).room_asked() is None  # a restarted worker in this block


@pytest.mark.alone
def test_many_connections_at_once_are_accepted_one_after_the_other(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    pauses: list[float] = []
    real = WorkerServer._pause_accepting

    def pause(server: WorkerServer, seconds: float) -> None:
        pauses.append(seconds)
        real(server, seconds)

    monkeypatch.setattr(WorkerServer, "_pause_accepting", pause)
    monkeypatch.setattr(worker_server, "ACCEPTS_AT_ONCE", 4)
    monkeypatch.setattr(worker_server, "ACCEPTS_PER_S", 100)
    with serving() as service:
        begin = time.monotonic()
        clients = [Served(service.port) for _ in range(24)]
        assert ask_each(clients) == [200] * 24
        assert time.monotonic() - begin >= 0.19  # (24 - 4 - 1) / 100
        assert pauses
