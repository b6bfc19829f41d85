"""One engine with a short queue before it, and a thread of its own: the event loop stays free.

An engine is neither re-entrant nor thread-safe, and waiting longer than a few frames helps no
controller: what does not fit into the queue is refused at once. In a stream a newer frame takes a
queued one's place; a frame whose deadline has passed is dropped before it is decoded.

A frame that comes alone to a quick engine is answered by the event loop itself: the way to another
thread and back costs more than all else that is not the model. Whoever comes meanwhile would have
waited for that frame anyway. As soon as two frames wait, the thread takes them.
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

import numpy as np
from numpy.typing import NDArray

import trackfeatures as tf
from mtlnet.inference.engine import Engine
from mtlnet.inference.prediction import Prediction, decode_outputs
from serve.api.problems import DEADLINE_PASSED, NOT_READY, OVERLOADED, SUPERSEDED, Problem
from serve.scheduling.streams import Streams
from trackfeatures.camera import CameraParameters

SMOOTHING = 0.1  # weight of the latest frame in the mean time a frame takes
QUICK_MS = 10.0  # for so long the event loop may be kept from everything else
FULL_PAUSE_S = 0.002  # between two looks at who has come, while all of them are refused
QUICK_RUN = 8  # frames in a row that took no longer, before it is trusted with one
logger = logging.getLogger(__name__)

Reader = Callable[[CameraParameters], NDArray[np.uint8]]
Done = Callable[["Perceived | Exception"], None]


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

    answer: Prediction
    origin: dict[str, str]
    queue_ms: float
    decode_ms: float
    forward_ms: float


@dataclass(frozen=True, slots=True)
class Frame:
    """An image that waits: how to read its pixels, and what `serve.api.request_options` says of its
    turn.

    `stream` 0: of no stream. `small`: read in less time than the engine takes.
    """

    read: Reader
    stamp_ns: int
    stream: int = 0
    deadline_ns: int | None = None
    small: bool = False


class Slot:
    """A place in the queue, the frame that has it now, and who is told of its answer."""

    __slots__ = ("done", "frame")

    def __init__(self, frame: Frame, done: Done) -> None:
        self.frame = frame
        self.done = done


class FrameQueue:
    """Answers images with one engine, one at a time. Start it in a running event loop.

    All but what the thread does is for that loop's thread alone.
    """

    def __init__(
        self, engine: Engine, warm_up: Callable[[Engine], None], streams: Streams, queue: int
    ) -> None:
        self._loaded = load(engine)
        self._staged: tuple[Loaded, Callable[[], bool]] | None = None
        self._warm_up = warm_up
        self._warm: Future[None] = Future()
        self._ready = False
        self._streams = streams
        self._limit = queue
        self._waiting: deque[Slot] = deque()
        self._busy = False  # the thread has a frame in work
        self._awake = False  # somebody is about to look at the queue
        self._lock = threading.Lock()
        self._pausing = False  # the loop is about to
        self._answered = threading.Lock()  # open from when the thread answers until a pause
        self._answered.acquire()
        self._calls: SimpleQueue[bool] = SimpleQueue()  # True: to the queue; False: the end
        self._frame_ms = 5.0
        self._quick = 0  # frames in a row of this engine that took no longer than QUICK_MS
        self._thread = threading.Thread(target=self._run, name="forward", daemon=True)

    @property
    def loaded(self) -> Loaded:
        """The engine that answers the next frame."""
        staged = self._staged
        if staged is not None and staged[1]():
            self._loaded, self._staged, self._quick = staged[0], None, 0
        return self._loaded

    @property
    def ready(self) -> bool:
        """Whether the engine is warm and has given its golden answer."""
        return self._ready

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
        if self._ready:
            return
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

    def check_room(self) -> None:
        """Raise Problem when a frame that takes no other's place would be refused."""
        if self._full():
            if not self._pausing:
                self._pausing = True
                self._loop.call_soon(self._pause)
            raise self._overloaded()

    def _full(self) -> bool:
        return len(self._waiting) + self._busy > self._limit

    def _pause(self) -> None:
        """Keep the loop from its clients until some have come, or a frame is answered.

        To refuse several at once takes less of the core than to be woken by each, and the engine
        needs that core.
        """
        self._pausing = False
        if self._full():
            self._answered.acquire(timeout=FULL_PAUSE_S)

    def admit(self, frame: Frame, done: Done) -> None:
        """Have `done` called with what the model sees in a frame, or with the error it got.

        Raises Problem at once where there is no room or no engine yet.
        """
        self.check_ready()
        lost = None
        with self._lock:
            if frame.stream:
                lost = self._replace(frame, done)
            if lost is None:
                self.check_room()
                self._waiting.append(Slot(frame, done))
                if not self._awake:
                    self._awake = True
                    # Not at once: first all is read that came in the meantime.
                    self._loop.call_soon(self._begin)
        if lost is not None:
            lost(Problem(SUPERSEDED, "a newer frame of this stream came meanwhile"))
        if frame.stream:
            self._streams.announce(frame.stream, frame.stamp_ns)

    def _replace(self, frame: Frame, done: Done) -> Done | None:
        """Put a frame in the place of its stream's queued one; whoever has lost their turn."""
        for queued in self._waiting:
            if queued.frame.stream != frame.stream:
                continue
            if queued.frame.stamp_ns > frame.stamp_ns:
                return done
            lost = queued.done
            queued.frame, queued.done = frame, done
            return lost
        return None

    def _begin(self) -> None:
        """Answer a lone small frame here; leave all else to the thread."""
        if self._quick < QUICK_RUN or len(self._waiting) > 1 or not self._waiting[0].frame.small:
            self._calls.put(True)
            return
        turn = self._waiting.popleft()
        result = self._attempt(turn.frame)
        self._awake = False
        turn.done(result)

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
        self._ready = True
        self._warm.set_result(None)
        while self._calls.get():
            while (turn := self._next()) is not None:
                result = self._attempt(turn.frame)
                self._loop.call_soon_threadsafe(turn.done, result)
                if self._answered.locked():
                    self._answered.release()

    def _next(self) -> Slot | None:
        """The thread's next turn; None: it may rest."""
        with self._lock:
            self._busy = self._awake = bool(self._waiting)
            return self._waiting.popleft() if self._waiting else None

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
        answer = decode_outputs(loaded.engine(image))
        end = time.monotonic_ns()
        frame_ms = (end - start) / 1e6
        self._frame_ms += SMOOTHING * (frame_ms - self._frame_ms)
        self._quick = self._quick + 1 if frame_ms <= QUICK_MS else 0
        return Perceived(
            answer,
            loaded.origin,
            (start - frame.stamp_ns) / 1e6,
            (decoded - start) / 1e6,
            (end - decoded) / 1e6,
        )

    def close(self) -> None:
        """Finish what was begun and what waits, end the thread."""
        for last in (True, False):
            self._calls.put(last)
        self._thread.join()
