"""The frame queue without a server: its model, and its behaviour when it is full."""

import asyncio
import math
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from mtlnet.inference.engine import Engine
from serve.problems import Problem
from serve.scheduling import frame_queue
from serve.scheduling.fair_queue import MAX_CLIENTS, FairQueue, Slot
from serve.scheduling.frame import Frame, FrameResult
from serve.scheduling.frame_queue import INLINE_AFTER, FrameQueue
from serve.scheduling.streams import StreamTable
from serve.shared_memory import create_shared_memory
from tests.serve.conftest import PATIENCE_S, Gate, constant_engine, picture, until


def make_queue(engine: Engine, capacity: int = 0, single_core: bool = False) -> FrameQueue:
    streams = StreamTable(create_shared_memory(1).streams())
    return FrameQueue(engine, lambda _engine: None, streams, capacity, single_core)


def start(queue: FrameQueue) -> None:
    """Start the queue in the running event loop; returns once its engine is ready."""
    queue.start()
    until(lambda: queue.ready)


def make_frame() -> Frame:
    return Frame(lambda _camera: np.ascontiguousarray(picture()), stamp_ns=0)


def test_reading_the_engine_changes_no_state() -> None:
    """The event loop reads `loaded` while the engine's thread works."""
    queue = make_queue(constant_engine())
    new = constant_engine()
    queue.stage_model(new, {}, lambda: True)
    before = dict(vars(queue))
    assert queue.loaded.engine is new
    assert vars(queue) == before


def test_a_committed_engine_is_kept_when_another_is_staged_or_dropped() -> None:
    queue = make_queue(constant_engine())
    committed, next_one = constant_engine(), constant_engine()
    queue.stage_model(committed, {}, lambda: True)
    queue.stage_model(next_one, {}, lambda: False)
    assert queue.loaded.engine is committed
    queue.drop_staged_model()
    assert queue.loaded.engine is committed
    queue.stage_model(next_one, {}, lambda: True)
    queue.drop_staged_model()
    assert queue.loaded.engine is next_one


def test_a_refusal_schedules_nothing_on_the_event_loop(monkeypatch: pytest.MonkeyPatch) -> None:
    """A full queue must not delay the event loop, which also answers probes."""
    gate = Gate()
    queue = make_queue(gate.engine)

    async def scenario() -> list[Any]:
        loop = asyncio.get_running_loop()
        start(queue)
        result: asyncio.Future[FrameResult | Exception] = loop.create_future()
        queue.submit(make_frame(), result.set_result)
        await asyncio.sleep(0)
        until(gate.busy.is_set)
        scheduled: list[Callable[..., Any]] = []
        monkeypatch.setattr(loop, "call_soon", lambda call, *_: scheduled.append(call))
        with pytest.raises(Problem, match="send this frame or a newer one later"):
            queue.submit(make_frame(), result.set_result)
        monkeypatch.undo()
        gate.open.set()
        assert isinstance(await result, FrameResult)
        queue.close()
        return scheduled

    assert asyncio.run(scenario()) == []


@pytest.mark.parametrize("single_core", [False, True])
def test_frames_that_wait_together_are_processed_on_the_loop_by_a_worker_with_one_core(
    single_core: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """On one core the thread and the loop would interrupt each other. Between two frames the loop
    does other work."""
    monkeypatch.setattr(frame_queue, "INLINE_MAX_MS", math.inf)  # holds on a busy machine too
    events: list[str] = []
    queue = make_queue(constant_engine(), 4, single_core)

    def read(_camera: object) -> Any:
        events.append(threading.current_thread().name)
        return np.ascontiguousarray(picture())

    frame = Frame(read, stamp_ns=0, small=True)

    async def submit(count: int) -> None:
        loop = asyncio.get_running_loop()
        results = [loop.create_future() for _ in range(count)]
        for result in results:
            queue.submit(frame, result.set_result)
        while not results[-1].done():
            await asyncio.sleep(0)
            events.append("other work")

    async def scenario() -> None:
        start(queue)
        end = time.monotonic() + PATIENCE_S
        while "MainThread" not in events:  # then the engine counts as fast, and the thread sleeps
            assert time.monotonic() < end
            await submit(1)
        events.clear()
        await submit(3)
        queue.close()

    asyncio.run(scenario())
    if single_core:
        assert events == ["MainThread", "other work"] * 3
    else:
        assert [event for event in events if event != "other work"] == ["forward"] * 3


def test_a_worker_that_stops_while_frames_wait_for_its_loop_answers_them(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(frame_queue, "INLINE_MAX_MS", math.inf)
    queue = make_queue(constant_engine(), 4, single_core=True)
    frame = replace(make_frame(), small=True)

    async def scenario() -> list[FrameResult | Exception]:
        start(queue)
        loop = asyncio.get_running_loop()
        errors: list[dict[str, Any]] = []
        loop.set_exception_handler(lambda _loop, context: errors.append(context))
        for _ in range(INLINE_AFTER):
            result = loop.create_future()
            queue.submit(frame, result.set_result)
            await result
        results = [loop.create_future() for _ in range(3)]
        for result in results:
            queue.submit(frame, result.set_result)
        queue.close()
        found = [await result for result in results]
        assert errors == []
        return found

    assert all(isinstance(result, FrameResult) for result in asyncio.run(scenario()))


def test_a_refusal_of_many_frames_holds_none_of_their_bodies() -> None:
    queue = make_queue(constant_engine(), capacity=1)
    for _ in range(2):
        queue._waiting.append(slot("10.0.0.1"))
    first = queue.refusal("10.0.0.1")
    assert first is not None
    assert queue.refusal("10.0.0.1") is first
    assert "2 frames are waiting" in first.detail
    queue._waiting.append(slot("10.0.0.1"))
    assert queue.refusal("10.0.0.2") is None  # a slot of the other client would be given up


def slot(client: str) -> Slot:
    frame = replace(make_frame(), client=client)
    return Slot(frame, lambda _result: None)


def test_clients_take_turns() -> None:
    queue = FairQueue()
    many, few = [slot("10.0.0.1") for _ in range(4)], [slot("10.0.0.2") for _ in range(2)]
    for each in (*many[:3], *few, many[3]):
        queue.append(each)
    taken = [queue.take() for _ in range(6)]
    assert taken == [many[0], few[0], many[1], few[1], many[2], many[3]]
    assert queue.count == 0


def test_the_last_frame_of_the_client_with_most_gives_way_to_one_with_fewer() -> None:
    queue = FairQueue()
    slots = [slot("10.0.0.1"), slot("10.0.0.2"), slot("10.0.0.1"), slot("10.0.0.1")]
    for each in slots:
        queue.append(each)
    assert queue.giving_way_to("10.0.0.3") is slots[3]
    assert queue.giving_way_to("10.0.0.2") is slots[3]
    assert queue.giving_way_to("10.0.0.1") is None
    queue.remove(slots[3])
    assert queue.giving_way_to("10.0.0.2") is None  # else it would have more slots
    assert queue.giving_way_to("2001:db8::1") is slots[2]


def test_the_turns_of_a_limited_number_of_clients_are_kept() -> None:
    queue = FairQueue()
    for number in range(MAX_CLIENTS + 10):
        queue.append(slot(f"10.0.{number // 256}.{number % 256}"))
        queue.take()
    assert len(queue._turns) == MAX_CLIENTS


def test_a_full_queue_takes_a_frame_of_another_client() -> None:
    gate = Gate()
    queue = make_queue(gate.engine, capacity=2)

    async def scenario() -> list[object]:
        start(queue)
        results: dict[str, asyncio.Future[FrameResult | Exception]] = {}

        async def submit(name: str, client: str) -> None:
            results[name] = asyncio.get_running_loop().create_future()
            assert queue.refusal(client) is None
            queue.submit(replace(make_frame(), client=client), results[name].set_result)
            await asyncio.sleep(0)

        await submit("first", "10.0.0.1")
        until(gate.busy.is_set)
        await submit("second", "10.0.0.1")
        await submit("third", "10.0.0.1")
        await submit("other", "10.0.0.2")
        assert queue.refusal("10.0.0.1") is not None
        gate.open.set()
        found: list[object] = [
            await results[name] for name in ("first", "other", "second", "third")
        ]
        queue.close()
        return found

    *answered, refused = asyncio.run(scenario())
    assert all(isinstance(result, FrameResult) for result in answered)
    assert isinstance(refused, Problem)
    assert refused.type.name == "overloaded"
