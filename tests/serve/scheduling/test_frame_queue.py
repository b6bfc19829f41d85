"""The frame queue's model and its behaviour when it is full, without a server."""

import asyncio
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from mtlnet.inference.engine import Engine
from serve.api.problems import Problem
from serve.scheduling.frame_queue import Frame, FrameQueue, FrameResult
from serve.scheduling.streams import StreamTable
from serve.workers.shared_memory import create_shared_memory
from tests.serve.conftest import FakeEngine, Gate, outputs, picture, until


def make_engine() -> Engine:
    return FakeEngine(lambda _image: outputs())


def make_queue(engine: Engine, capacity: int = 0) -> FrameQueue:
    streams = StreamTable(create_shared_memory(1).streams())
    return FrameQueue(engine, lambda _engine: None, streams, capacity)


def make_frame() -> Frame:
    return Frame(lambda _camera: np.ascontiguousarray(picture()), stamp_ns=0)


def test_reading_the_engine_changes_no_state() -> None:
    """It is read from the event loop while the engine's thread works."""
    queue = make_queue(make_engine())
    new = make_engine()
    queue.stage_model(new, lambda: True)
    before = dict(vars(queue))
    assert queue.loaded.engine is new
    assert vars(queue) == before


def test_a_committed_engine_is_kept_when_another_is_staged_or_dropped() -> None:
    queue = make_queue(make_engine())
    committed, next_one = make_engine(), make_engine()
    queue.stage_model(committed, lambda: True)
    queue.stage_model(next_one, lambda: False)
    assert queue.loaded.engine is committed
    queue.drop_staged_model()
    assert queue.loaded.engine is committed
    queue.stage_model(next_one, lambda: True)
    queue.drop_staged_model()
    assert queue.loaded.engine is next_one


def test_a_refusal_schedules_nothing_on_the_event_loop(monkeypatch: pytest.MonkeyPatch) -> None:
    """A full queue must not make the loop wait: it also answers probes."""
    gate = Gate()
    queue = make_queue(gate.engine)

    async def scenario() -> list[Any]:
        loop = asyncio.get_running_loop()
        queue.start()
        until(lambda: queue.ready)
        result: asyncio.Future[FrameResult | Exception] = loop.create_future()
        queue.submit(make_frame(), result.set_result)
        await asyncio.sleep(0)
        until(gate.busy.is_set)
        scheduled: list[Callable[..., Any]] = []
        monkeypatch.setattr(loop, "call_soon", lambda call, *_: scheduled.append(call))
        with pytest.raises(Problem, match="send this one or a newer one later"):
            queue.submit(make_frame(), result.set_result)
        monkeypatch.undo()
        gate.open.set()
        assert isinstance(await result, FrameResult)
        queue.close()
        return scheduled

    assert asyncio.run(scenario()) == []
