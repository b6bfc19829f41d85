"""One engine in one thread of its own, with a short queue before it: the event loop stays free.

An engine is neither re-entrant nor thread-safe, and waiting longer than a few frames helps no
controller: what does not fit into the queue is refused at once. In a stream a newer frame takes a
queued one's place; a frame whose deadline has passed is dropped before it is decoded.
"""

import asyncio
import logging
import threading
import time
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass
from queue import SimpleQueue
from typing import Any

import numpy as np
from numpy.typing import NDArray

import trackfeatures as tf
from mtlnet.answer import Answer, interpret
from mtlnet.card import Camera
from mtlnet.engine import Engine
from serve.problems import DEADLINE_PASSED, NOT_READY, OVERLOADED, SUPERSEDED, Problem
from serve.streams import Streams

SMOOTHING = 0.1  # weight of the latest frame in the mean time a frame takes
logger = logging.getLogger(__name__)

Reader = Callable[[Camera], NDArray[np.uint8]]


@dataclass(frozen=True, slots=True)
class Loaded:
    """An engine, and what every answer says of it."""

    engine: Engine
    origin: dict[str, str]


def load(engine: Engine) -> Loaded:
    """`engine` with its origin."""
    origin = {
        "model": engine.card.model_hash,
        "definitions_version": tf.VERSION,
        "engine": engine.kind,
        "precision": engine.precision,
    }
    return Loaded(engine, origin)


@dataclass(frozen=True, slots=True)
class Perceived:
    """An answer, the engine it is from, and where its time went, ms."""

    answer: Answer
    origin: dict[str, str]
    queue_ms: float
    decode_ms: float
    forward_ms: float


@dataclass(frozen=True, slots=True)
class Frame:
    """An image that waits: how to read its pixels, and what `serve.ask` says of its turn.

    `stream` 0: of no stream.
    """

    read: Reader
    stamp_ns: int
    stream: int = 0
    deadline_ns: int | None = None


class Turn:
    """A place in the queue, and the frame that has it now."""

    __slots__ = ("frame", "future")

    def __init__(self, frame: Frame, future: asyncio.Future[Perceived]) -> None:
        self.frame = frame
        self.future = future


class Perceiver:
    """Answers images with one engine, one at a time. Start it in a running event loop."""

    def __init__(
        self, engine: Engine, warm_up: Callable[[Engine], None], streams: Streams, queue: int
    ) -> None:
        self._loaded = load(engine)
        self._staged: tuple[Loaded, Callable[[], bool]] | None = None
        self._warm_up = warm_up
        self._warm: Future[None] = Future()
        self._streams = streams
        self._limit = queue
        self._waiting: deque[Turn] = deque()
        self._busy = False
        self._lock = threading.Lock()
        self._calls: SimpleQueue[bool] = SimpleQueue()  # one True a turn; False: the end
        self._frame_ms = 5.0
        self._thread = threading.Thread(target=self._run, name="forward", daemon=True)

    @property
    def loaded(self) -> Loaded:
        """The engine that answers the next frame."""
        staged = self._staged
        if staged is not None and staged[1]():
            self._loaded, self._staged = staged[0], None
        return self._loaded

    @property
    def waiting(self) -> int:
        """Frames in the queue."""
        return len(self._waiting)

    def start(self) -> None:
        """Warm the engine up behind the caller's back; `check_ready` says when that is done."""
        self._loop = asyncio.get_running_loop()
        self._thread.start()

    def check_ready(self) -> None:
        """Raise Problem until the engine is warm and has given its golden answer."""
        if not self._warm.done():
            raise Problem(NOT_READY, "the model is warming up; ask again in a second")
        fault = self._warm.exception()
        if fault is not None:
            raise Problem(NOT_READY, f"the model failed its check and answers nothing: {fault}")

    def stage(self, engine: Engine, chosen: Callable[[], bool]) -> None:
        """Answer with `engine`, warm and checked, from the first frame on for which `chosen`."""
        self._staged = load(engine), chosen

    def drop(self) -> None:
        """Forget what was staged."""
        self._staged = None

    def when_warm(self, do: Callable[[], None]) -> None:
        """Call `do`, in another thread, once the engine is warm and right."""
        self._warm.add_done_callback(lambda warm: None if warm.exception() else do())

    def perceive(self, frame: Frame) -> "asyncio.Future[Perceived]":
        """What the model sees in a frame; the future may raise Problem, ImageError.

        Raises Problem at once where there is no room or no engine yet.
        """
        self.check_ready()
        future: asyncio.Future[Perceived] = self._loop.create_future()
        turn = Turn(frame, future)
        with self._lock:
            replaced = self._replace(turn) if frame.stream else None
            if replaced is None:
                if len(self._waiting) + self._busy > self._limit:
                    raise self._overloaded()
                self._waiting.append(turn)
                self._calls.put(True)
        if replaced is not None:
            _fail(replaced, Problem(SUPERSEDED, "a newer frame of this stream came meanwhile"))
        if frame.stream:
            self._streams.announce(frame.stream, frame.stamp_ns)
        return future

    def _replace(self, turn: Turn) -> "asyncio.Future[Perceived] | None":
        """Put a frame in the place of its stream's queued one; whose future has lost its turn."""
        for queued in self._waiting:
            if queued.frame.stream != turn.frame.stream:
                continue
            if queued.frame.stamp_ns > turn.frame.stamp_ns:
                return turn.future
            lost = queued.future
            queued.frame, queued.future = turn.frame, turn.future
            return lost
        return None

    def _overloaded(self) -> Problem:
        waiting = len(self._waiting)
        return Problem(
            OVERLOADED,
            f"{waiting} frames wait already; send this one again later, or a newer one, or start "
            "the service with more --workers",
            self._frame_ms * (waiting + 1),
        )

    def _run(self) -> None:
        try:
            self._warm_up(self._loaded.engine)
        except tf.UserError as error:
            logger.error("the model failed its check and answers nothing: %s", error)
            self._warm.set_exception(error)
            return
        except Exception as error:  # any fault of a model must show in /readyz
            logger.exception("the model failed its check and answers nothing")
            self._warm.set_exception(error)
            return
        self._warm.set_result(None)
        while self._calls.get():
            with self._lock:
                turn = self._waiting.popleft()
                self._busy = True
            result = self._attempt(turn.frame)
            self._busy = False
            self._loop.call_soon_threadsafe(_settle, turn.future, result)

    def _attempt(self, frame: Frame) -> "Perceived | Exception":
        try:
            return self._perceive(frame)
        except tf.UserError as error:
            return error
        except Exception as error:  # goes to who asked, and never ends the thread
            logger.exception("a frame failed")
            return error

    def _perceive(self, frame: Frame) -> Perceived:
        start = time.monotonic_ns()
        if frame.deadline_ns is not None and start > frame.deadline_ns:
            late_ms = (start - frame.deadline_ns) / 1e6
            raise Problem(DEADLINE_PASSED, f"its turn came {late_ms:.1f} ms after its deadline")
        if frame.stream and self._streams.superseded(frame.stream, frame.stamp_ns):
            raise Problem(SUPERSEDED, "a newer frame of this stream came meanwhile")
        loaded = self.loaded
        image = frame.read(loaded.engine.card.camera)
        decoded = time.monotonic_ns()
        answer = interpret(loaded.engine(image))
        end = time.monotonic_ns()
        self._frame_ms += SMOOTHING * ((end - start) / 1e6 - self._frame_ms)
        return Perceived(
            answer,
            loaded.origin,
            (start - frame.stamp_ns) / 1e6,
            (decoded - start) / 1e6,
            (end - decoded) / 1e6,
        )

    def close(self) -> None:
        """Finish what was begun and what waits, end the thread."""
        self._calls.put(False)
        self._thread.join()


def _settle(future: "asyncio.Future[Perceived]", result: Perceived | Exception) -> None:
    if future.done():  # whoever asked was cancelled
        return
    if isinstance(result, Exception):
        future.set_exception(result)
    else:
        future.set_result(result)


def _fail(future: "asyncio.Future[Any]", problem: Problem) -> None:
    if not future.done():
        future.set_exception(problem)
