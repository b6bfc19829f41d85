"""Measures how long a function, or a complete request, blocks the event loop."""

import asyncio
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress

from mtlnet.inference.image_decoding.errors import ImageError
from serve.problems import Problem
from tests.serve.conftest import PATIENCE_S, Served

LOOP_S = 0.02  # longest time for which a request may block the event loop
TRIES, TRYING_S = 5, 5.0  # the fastest try counts, because a busy machine slows some tries
TICK_S = 0.0005


def held_s(work: Callable[[], object], limit_s: float = LOOP_S) -> float:
    """The least processor time of several calls of `work` in s; the calls end when one is below
    `limit_s`. `work` can raise a refusal."""

    def measured_s() -> float:
        start_s = time.thread_time()
        with suppress(Problem, ImageError):
            work()
        return time.thread_time() - start_s

    return least_s(measured_s, limit_s)


def least_s(measure: Callable[[], float], limit_s: float = LOOP_S, at_least: int = TRIES) -> float:
    """The least result of `measure` in `at_least` or more tries, which end with one below
    `limit_s` or after TRYING_S."""
    least, tries, end_s = float("inf"), 0, time.monotonic() + TRYING_S
    while tries < at_least or (least >= limit_s and time.monotonic() < end_s):
        least, tries = min(least, measure()), tries + 1
    return least


class LoopWatch:
    """Measures the longest processor time of an event loop between two ticks of TICK_S."""

    def __init__(self) -> None:
        self.longest_s = 0.0
        self.stopped = False

    def tick(self, last_s: float | None = None) -> None:
        """Measure the time since the last tick, and schedule the next tick."""
        now_s = time.thread_time()
        if last_s is not None:
            self.longest_s = max(self.longest_s, now_s - last_s)
        if not self.stopped:
            asyncio.get_running_loop().call_later(TICK_S, self.tick, now_s)


@contextmanager
def watched(service: Served) -> Iterator[LoopWatch]:
    """A LoopWatch on a service in this process; its times include parsing, joining, answering."""
    watch, loop, ended = LoopWatch(), service.server._loop, threading.Event()

    def end() -> None:
        watch.stopped = True
        loop.call_later(4 * TICK_S, ended.set)

    loop.call_soon_threadsafe(watch.tick)
    yield watch
    loop.call_soon_threadsafe(end)
    assert ended.wait(PATIENCE_S)
