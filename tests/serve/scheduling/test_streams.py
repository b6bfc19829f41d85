"""A newer frame replaces the queued frame of its stream in all workers; late frames are dropped."""

from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager

from serve import shared_memory
from serve.scheduling.streams import EXPIRY_NS, StreamTable, stream_key
from serve.shared_memory import PROBES
from tests.serve.conftest import (
    JPEG,
    PATIENCE_S,
    Gate,
    Reply,
    Served,
    assert_problem,
    busy,
    serving,
    until,
)


class Crowd:
    """Clients of a service, each with its own connection and thread."""

    def __init__(self, service: Served, pool: ThreadPoolExecutor) -> None:
        self._service, self._pool = service, pool

    def post(self, **headers: str) -> "Future[Reply]":
        return self._pool.submit(lambda: Served(self._service.port).post(JPEG, **headers))

    def queue(self, waiting: int, **headers: str) -> "Future[Reply]":
        """Post an image, and return once `waiting` frames are in the queue."""
        future = self.post(**headers)
        until(lambda: self._service.app.frame_queue.waiting == waiting)
        return future


@contextmanager
def crowded(memory: shared_memory.SharedMemory | None = None) -> Iterator[tuple[Crowd, Gate]]:
    """Clients of a service whose engine is busy with a first frame until the gate is opened."""
    with busy(shared=memory) as (service, gate), ThreadPoolExecutor(8) as pool:
        yield Crowd(service, pool), gate


def test_a_newer_frame_replaces_the_queued_one_at_once() -> None:
    with crowded() as (crowd, gate):
        old = crowd.queue(1, X_Stream_Id="front")
        other = crowd.queue(2, X_Stream_Id="rear")
        alone = crowd.queue(3)
        new = crowd.post(X_Stream_Id="front")
        assert_problem(old.result(PATIENCE_S), 503, "superseded")  # the engine is still busy
        gate.open.set()
        assert [f.result().status for f in (new, other, alone)] == [200] * 3
    assert len(gate.engine.images) == 4


def test_a_full_queue_still_takes_a_newer_frame_of_a_queued_stream() -> None:
    with crowded() as (crowd, gate):
        old = crowd.queue(1, X_Stream_Id="front")
        others = [crowd.queue(n) for n in (2, 3, 4)]
        assert_problem(crowd.post(X_Stream_Id="rear").result(PATIENCE_S), 503, "overloaded")
        new = crowd.post(X_Stream_Id="front")
        assert_problem(old.result(PATIENCE_S), 503, "superseded")
        gate.open.set()
        assert [f.result().status for f in (new, *others)] == [200] * 4


def test_a_newer_frame_at_another_worker_replaces_an_older_one() -> None:
    memory = shared_memory.create_shared_memory(blocks=2)
    with crowded(memory) as (crowd, gate):
        old = crowd.queue(1, X_Stream_Id="front")
        kept = crowd.queue(2, X_Stream_Id="rear")
        with serving(shared=memory, block=1) as second:
            assert second.post(JPEG, X_Stream_Id="front").status == 200
        gate.open.set()
        assert_problem(old.result(), 503, "superseded")
        assert kept.result().status == 200
    assert len(gate.engine.images) == 2


def test_a_late_frame_is_dropped_before_it_is_decoded() -> None:
    with crowded() as (crowd, gate):
        late = crowd.queue(1, X_Deadline_Ms="0")
        early = crowd.queue(2, X_Deadline_Ms="60000")
        gate.open.set()
        assert_problem(late.result(), 503, "deadline-passed")
        assert early.result().status == 200
    assert len(gate.engine.images) == 2


def test_the_table_holds_the_newest_stamp_of_each_stream() -> None:
    memory = shared_memory.create_shared_memory(blocks=1)
    here = StreamTable(memory.streams())
    there = StreamTable(shared_memory.attach_shared_memory(memory.fd, 1).streams())
    front, other = stream_key("10.0.0.1", "front"), stream_key("10.0.0.2", "front")
    assert front != other
    now = 10 * EXPIRY_NS
    here.announce(front, now)
    assert [there.is_superseded(front, now + d) for d in (-1, 0, 1)] == [True, False, False]
    assert not there.is_superseded(other, 0)
    there.announce(front, now - 5)  # an older stamp has no effect
    assert here.is_superseded(front, now - 1)


def test_a_full_table_drops_streams_that_have_ended() -> None:
    streams = StreamTable(shared_memory.create_shared_memory(blocks=1).streams())
    now = 10 * EXPIRY_NS
    keys = [1 + 1024 * n for n in range(PROBES + 1)]  # all have the same hash
    for key in keys:
        streams.announce(key, now)
    assert [streams.is_superseded(key, now - 1) for key in keys] == [True] * PROBES + [False]
    later = now + EXPIRY_NS + 1
    streams.announce(keys[-1], later)
    assert streams.is_superseded(keys[-1], later - 1)
    assert not streams.is_superseded(keys[0], now - 1)
