"""One engine in one thread of its own, with a short queue before it: the event loop stays free.

An engine is neither re-entrant nor thread-safe, and waiting longer than a few frames helps no
controller: what does not fit into the queue is refused at once.
"""

import asyncio
import logging
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from typing import TypeVar

from mtlnet.answer import Answer, interpret
from mtlnet.engine import Engine
from mtlnet.images import ImageHeader, decode
from serve.problems import NOT_READY, OVERLOADED, Problem

QUEUE = 4  # frames that may wait while one is answered
T = TypeVar("T")
logger = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Perceived:
    """An answer and where its time went, ms."""

    answer: Answer
    decode_ms: float
    forward_ms: float


class Perceiver:
    """Answers images with one engine, one at a time. Start it in a running event loop."""

    def __init__(self, engine: Engine, warm_up: Callable[[Engine], None]) -> None:
        self.engine = engine
        self._warm_up = warm_up
        self._warm: Future[None] | None = None
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="forward")
        self._slots = threading.BoundedSemaphore(1 + QUEUE)

    def start(self) -> None:
        """Warm the engine up behind the caller's back; `check_ready` says when that is done."""
        self._warm = self._thread.submit(self._warm_up, self.engine)
        self._warm.add_done_callback(_report)

    def check_ready(self) -> None:
        """Raise Problem until the engine is warm and has given its golden answer."""
        if self._warm is None or not self._warm.done():
            raise Problem(NOT_READY, "the model is warming up; ask again in a second")
        fault = None if self._warm.cancelled() else self._warm.exception()
        if fault is not None:
            raise Problem(NOT_READY, f"the model failed its check and answers nothing: {fault}")

    async def perceive(self, body: bytes, header: ImageHeader) -> Perceived:
        """What the model sees in an image that passed `mtlnet.images.inspect`.

        Raises Problem, ImageError.
        """
        self.check_ready()
        return await self._in_thread(lambda: self._perceive(body, header))

    async def _in_thread(self, work: Callable[[], T]) -> T:
        if not self._slots.acquire(blocking=False):
            raise Problem(
                OVERLOADED,
                f"{QUEUE} frames wait already; send this one again later, or a newer one, or "
                "start the service with more --workers",
            )
        future = self._thread.submit(work)
        # Released when the work is over, not when its client has left.
        future.add_done_callback(lambda _: self._slots.release())
        return await asyncio.wrap_future(future)

    def _perceive(self, body: bytes, header: ImageHeader) -> Perceived:
        start = time.perf_counter()
        image = decode(body, header, self.engine.card.camera)
        decoded = time.perf_counter()
        answer = interpret(self.engine(image))
        end = time.perf_counter()
        return Perceived(answer, 1e3 * (decoded - start), 1e3 * (end - decoded))

    def close(self) -> None:
        """Finish what was begun, drop what waits, end the thread."""
        self._thread.shutdown(wait=True, cancel_futures=True)


def _report(warm: Future[None]) -> None:
    """Say on the console, too, that this process will never be ready."""
    fault = None if warm.cancelled() else warm.exception()
    if fault is not None:
        logger.error("the model failed its check and answers nothing: %s", fault)
