"""Whose turn a connection is, among the workers that listen on one port."""

import threading

from serve.workers import shared_memory
from serve.workers.shared_memory import WorkerPeers
from tests.serve.conftest import FakeEngine, Served, jpeg, outputs, picture, serving, until

JPEG = jpeg(picture())


def clients(port: int) -> list[Served]:
    return [Served(port) for _ in range(8)]


def ask_anew(asking: list[Served]) -> list[int]:
    """The status that each client gets, all of whose connections stay open."""
    return [client.post(JPEG).status for client in asking]


def test_a_worker_that_warms_up_leaves_connections_to_one_that_can_answer() -> None:
    memory = shared_memory.create_shared_memory(blocks=2)
    ours, others = FakeEngine(lambda _image: outputs()), FakeEngine(lambda _image: outputs())
    warm = threading.Event()
    with (
        serving(ours, shared=memory) as one,
        serving(others, lambda _engine: warm.wait(20), shared=memory, block=1, beside=one) as two,
    ):
        until(lambda: one.app.frame_queue.ready)
        until(WorkerPeers(memory, 1).other_is_ready)
        early, late = clients(one.port), clients(one.port)
        assert ask_anew(early) == [200] * 8
        assert not others.images
        warm.set()
        until(lambda: two.app.frame_queue.ready)
        assert ask_anew(late) == [200] * 8
        assert others.images  # it has fewer connections, so they are its turn


def test_where_none_can_answer_yet_all_say_so() -> None:
    memory = shared_memory.create_shared_memory(blocks=2)
    engine = FakeEngine(lambda _image: outputs())
    warm = threading.Event()
    with (
        serving(engine, lambda _engine: warm.wait(20), shared=memory) as one,
        serving(engine, lambda _engine: warm.wait(20), shared=memory, block=1, beside=one),
    ):
        assert ask_anew(clients(one.port)) == [503] * 8
        warm.set()
