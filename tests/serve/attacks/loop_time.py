"""How long a piece of work, or a whole request, holds the event loop."""

import asyncio
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress

from mtlnet.inference.image_decoding.errors import ImageError
from serve.api.problems import Problem
from tests.serve.conftest import PATIENCE_S, Served

LOOP_S = 0.02  # for which one request may hold the event loop
TRIES, TRYING_S = 5, 5.0  # the quickest counts: the machine may be slower for a second
TICK_S = 0.0005


def held_s(work: Callable[[], object], limit_s: float = LOOP_S) -> float:
    """The least processor time of `work`, s, which may end with a refusal; or one under a limit."""

    def measured_s() -> float:
        start_s = time.thread_time()
        with suppress(Problem, ImageError):
            work()
        return time.thread_time() - start_s

    return least_s(measured_s, limit_s)


def least_s(measure: Callable[[], float], limit_s: float = LOOP_S, at_least: int = TRIES) -> float:
    """The least of what `measure` returns in `at_least` tries, or one under a limit."""
    least, tries, end_s = float("inf"), 0, time.monotonic() + TRYING_S
    while tries < at_least or (least >= limit_s and time.monotonic() < end_s):
        least, tries = min(least, measure()), tries + 1
    return least


class LoopWatch:
    """The longest processor time of a service's event loop between two of its ticks."""

    def __init__(self) -> None:
        self.longest_s = 0.0
        self.stopped = False

    def tick(self, last_s: float | None = None) -> None:
        """Measure, and come again."""
        now_s = time.thread_time()
        if last_s is not None:
            self.longest_s = max(self.longest_s, now_s - last_s)
        if not self.stopped:
            asyncio.get_running_loop().call_later(TICK_S, self.tick, now_s)


@contextmanager
def watched(service: Served) -> Iterator[LoopWatch]:
    """A watch over a service in this process; it includes parsing, joining and answering."""
    watch, loop, ended = LoopWatch(), service.server._loop, threading.Event()

    def end() -> None:
        watch.stopped = True
        loop.call_later(4 * TICK_S, ended.set)

    loop.call_soon_threadsafe(watch.tick)
    yield watch
    loop.call_soon_threadsafe(end)
    assert ended.wait(PATIENCE_S)
