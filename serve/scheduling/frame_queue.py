"""A short queue of frames in front of one engine, and the thread that runs the engine.

An engine is neither re-entrant nor thread-safe, and an old frame is useless to a controller, so a
frame that does not fit into the queue is refused at once. A newer frame of a stream replaces the
queued frame of that stream. A frame whose deadline has passed is dropped before it is decoded.
Clients take turns (`serve.scheduling.fair_queue`).

A small frame that arrives alone is processed on the event loop itself if the engine is fast: the
switch to another thread and back takes longer than all other work for the frame except the forward
pass. Frames that arrive in the meantime would have to wait for this frame anyway. Two or more
waiting frames go to the thread, unless the worker has no second core: on one core the thread and
the loop would only interrupt each other. Between two frames the loop handles all requests that have
arrived.
"""

import asyncio
import logging
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future
from functools import partial
from queue import SimpleQueue

import trackfeatures as tf
from mtlnet.inference.engine import Engine
from mtlnet.inference.prediction import decode_outputs
from serve.cameras import NO_CAMERAS, Cameras
from serve.problems import DEADLINE_PASSED, NOT_READY, SUPERSEDED, Problem
from serve.scheduling.fair_queue import FairQueue, Slot
from serve.scheduling.frame import Frame, FrameResult, ResultCallback
from serve.scheduling.loaded_engine import LoadedEngine, StagedEngine
from serve.scheduling.overload import Admission, queue_full, shared_queue_full
from serve.scheduling.streams import StreamTable

SMOOTHING = 0.1  # weight of the latest frame in the running mean of the time per frame
INLINE_MAX_MS = 10.0  # longest time per frame at which frames are processed on the event loop
# Images with a longer decoding time pass `Admission` first; 30 ms is the time of a JPEG of 3 Mpx.
LARGE_MS = 30.0
INLINE_AFTER = 8  # consecutive frames within INLINE_MAX_MS before the event loop runs the engine

logger = logging.getLogger(__name__)


class FrameQueue:
    """Processes frames with one engine, one at a time. Start it in a running event loop.

    Call `submit` and `refusal` in this loop's thread only. `stage_model` and
    `drop_staged_model` can be called in any thread.
    """

    def __init__(
        self,
        engine: Engine,
        warm_up: Callable[[Engine], None],
        streams: StreamTable,
        capacity: int,
        single_core: bool = False,
        cameras: Cameras = NO_CAMERAS,
    ) -> None:
        """At most `capacity` frames wait while a frame is processed. `warm_up` runs and checks the
        engine before the first frame. `streams` records the newest frame of each stream. With
        `single_core` (the worker has no second core) the event loop itself processes small frames
        even if several wait. `cameras` are the cameras that frames can name.
        """
        self._current = LoadedEngine.of(engine, cameras)
        self._staged: StagedEngine | None = None
        self._model_lock = threading.Lock()  # for _current and _staged; held briefly
        self._warm_up = warm_up
        self._warm: Future[None] = Future()
        self._ready = False
        self._streams = streams
        self._capacity = capacity
        self.single_core = single_core
        self._waiting = FairQueue()
        self._admission = Admission(self._waiting)
        self._queue_lock = threading.Lock()  # for _waiting; held briefly
        self._thread_busy = False  # the thread is processing a frame
        self._dispatched = False  # the loop or the thread will check the queue
        self._wake_ups: SimpleQueue[bool] = SimpleQueue()  # True: frames wait; False: stop
        self._mean_frame_ms = 5.0
        self._fast_engine: LoadedEngine | None = None  # the engine of the latest frame
        self._fast_frames = 0  # number of its latest consecutive frames within INLINE_MAX_MS
        self._thread = threading.Thread(target=self._run_thread, name="forward", daemon=True)

    @property
    def loaded(self) -> LoadedEngine:
        """The engine that will process the next frame."""
        with self._model_lock:
            staged = self._staged
            return staged.loaded if staged and staged.is_committed() else self._current

    @property
    def ready(self) -> bool:
        """Whether the engine is warm and has passed its check."""
        return self._ready

    @property
    def waiting(self) -> int:
        """Number of frames in the queue."""
        return self._waiting.count

    def start(self) -> None:
        """Start the thread, which warms up the engine. `check_ready` raises until that is done."""
        self._loop = asyncio.get_running_loop()
        self._thread.start()

    def check_ready(self) -> None:
        """Raise Problem until the engine is warm and has passed its check."""
        if self._ready:
            return
        if not self._warm.done():
            raise Problem(NOT_READY, "the model is warming up; ask again in a second")
        error = self._warm.exception()
        if error is not None:
            raise Problem(NOT_READY, f"the model failed its check; no image is answered: {error}")

    def stage_model(
        self, engine: Engine, cameras: Cameras, is_committed: Callable[[], bool]
    ) -> None:
        """Switch to `engine`, already warm and checked, and to `cameras`, the cameras that frames
        can name, once `is_committed()` returns True.

        `is_committed` is called at each frame.
        """
        loaded = LoadedEngine.of(engine, cameras)  # slow with many cameras: before the lock
        with self._model_lock:
            self._promote_staged()
            self._staged = StagedEngine(loaded, is_committed)

    def drop_staged_model(self) -> None:
        """Discard the staged engine, unless its `is_committed()` already returns True."""
        with self._model_lock:
            self._promote_staged()
            self._staged = None

    def _promote_staged(self) -> None:
        """Make a committed staged engine the current one. Call it with `_model_lock` held."""
        if self._staged is not None and self._staged.is_committed():
            self._current, self._staged = self._staged.loaded, None

    def on_warm(self, callback: Callable[[], None]) -> None:
        """Call `callback` in the engine's thread once the engine has passed its check."""
        self._warm.add_done_callback(lambda warm: None if warm.exception() else callback())

    @property
    def full(self) -> bool:
        """Whether a new frame would be refused if it replaces no queued frame."""
        return self._waiting.count + self._thread_busy > self._capacity

    @property
    def is_thread_behind(self) -> bool:
        """Whether the queue is full while the thread processes a frame."""
        return self._thread_busy and self.full

    def refusal(self, client: str) -> Problem | None:
        """Return the problem if the queue has no room for a client's frame, else None.

        Many frames share the returned object, so code that raises it must drop its traceback
        afterwards.
        """
        if not self.full:
            return None
        with self._queue_lock:
            if self._waiting.giving_way_to(client) is not None:
                return None
        return shared_queue_full(*self._load())

    def submit(self, frame: Frame, on_result: ResultCallback) -> None:
        """Queue a frame; `on_result` is called on the loop with its result or its error.

        Raises Problem at once if the queue is full or the engine is not ready.
        """
        self.check_ready()
        self._waiting.note(frame.client, frame.stamp_ns)
        if frame.cost_ms > LARGE_MS:
            refuse = self._enqueue_large(frame, on_result)
        else:
            refuse = self._enqueue(frame, on_result)
        if refuse is not None:
            refuse()
        if frame.stream:
            self._streams.announce(frame.stream, frame.stamp_ns)

    def _enqueue_large(self, frame: Frame, on_result: ResultCallback) -> Callable[[], None] | None:
        """Admit a large image and queue its frame; the admission ends with the frame's result.

        Returns the function that refuses the frame that this frame replaces; None if it replaces
        none. Raises Problem if the image is not admitted or the queue has no room.
        """
        done = self._admission.admit(frame.client, frame.cost_ms, frame.stamp_ns)

        def finish(result: FrameResult | Exception) -> None:
            done()
            on_result(result)

        try:
            return self._enqueue(frame, finish)
        except Problem:
            done()
            raise

    def _enqueue(self, frame: Frame, on_result: ResultCallback) -> Callable[[], None] | None:
        """Queue a frame. Returns the function that refuses the frame that this frame replaces; None
        if it replaces none. Raises Problem if the queue has no room."""
        with self._queue_lock:
            superseded = self._supersede(frame, on_result) if frame.stream else None
            if superseded is not None:
                problem = Problem(SUPERSEDED, "a newer frame of this stream arrived")
                return partial(superseded, problem)
            slot = Slot(frame, on_result)
            last = self._waiting.giving_way_to(frame.client) if self.full else None
            if last is not None:
                self._waiting.remove(last)
            elif self.full:
                raise queue_full(*self._load())
            self._waiting.append(slot)
            if not self._dispatched:
                self._dispatched = True
                # Called later, so that the loop first reads all requests that have arrived.
                self._loop.call_soon(self._dispatch)
            return None if last is None else partial(last.on_result, queue_full(*self._load()))

    def _supersede(self, frame: Frame, on_result: ResultCallback) -> ResultCallback | None:
        """Put a frame into its stream's slot, unless a newer frame is in this slot.

        Returns the callback of the older of the two frames; None if the stream has no slot.
        """
        slot = self._waiting.of_stream(frame.stream)
        if slot is None:
            return None
        if slot.frame.stamp_ns > frame.stamp_ns:
            return on_result
        superseded = slot.on_result
        slot.frame, slot.on_result = frame, on_result
        return superseded

    def _dispatch(self) -> None:
        """Process a small frame on the loop if the engine is fast and no other frame waits (with
        one core, other small frames can wait); else wake the thread."""
        fast = self._fast_frames >= INLINE_AFTER and self.loaded is self._fast_engine
        inline = 0 < self._waiting.count <= (self._capacity + 1 if self.single_core else 1)
        if not (fast and inline and self._waiting.all_small):
            self._wake_ups.put(True)
            return
        with self._queue_lock:
            slot = self._waiting.take()
        result = self._process(slot.frame)
        self._dispatched = self._waiting.count > 0
        if self._dispatched:
            self._loop.call_soon(self._dispatch)
        slot.on_result(result)

    def _load(self) -> tuple[int, int]:
        """The number of waiting frames, and the expected time to process them in ms."""
        waiting = self._waiting.count
        return waiting, max(1, round(self._mean_frame_ms * (waiting + 1)))

    def _run_thread(self) -> None:
        try:
            self._warm_up(self._current.engine)
        except tf.UserError as error:
            logger.error("the model failed its check; no image is answered: %s", error)
            self._warm.set_exception(error)
            return
        except Exception as error:  # /readyz must report any fault of a model
            logger.exception("the model failed its check; no image is answered")
            self._warm.set_exception(error)
            return
        self._ready = True
        self._warm.set_result(None)
        while self._wake_ups.get():
            while (slot := self._take_slot()) is not None:
                result = self._process(slot.frame)
                self._loop.call_soon_threadsafe(slot.on_result, result)

    def _take_slot(self) -> Slot | None:
        """Take the slot that the thread processes next; None if the queue is empty."""
        with self._queue_lock:
            self._thread_busy = self._dispatched = self._waiting.count > 0
            return self._waiting.take() if self._dispatched else None

    def _process(self, frame: Frame) -> "FrameResult | Exception":
        try:
            return self._infer(frame)
        except tf.UserError as error:
            return error.with_traceback(None)  # the traceback keeps the request's body in memory
        except Exception as error:  # reported to the client; the thread must not end
            logger.exception("a frame failed")
            return error

    def _infer(self, frame: Frame) -> FrameResult:
        start = time.monotonic_ns()
        if frame.deadline_ns is not None and start > frame.deadline_ns:
            late_ms = (start - frame.deadline_ns) / 1e6
            raise Problem(DEADLINE_PASSED, f"its turn came {late_ms:.1f} ms after its deadline")
        if frame.stream and self._streams.is_superseded(frame.stream, frame.stamp_ns):
            raise Problem(SUPERSEDED, "a newer frame of this stream arrived")
        with self._model_lock:
            self._promote_staged()
            loaded = self._current
        if loaded is not self._fast_engine:
            self._fast_engine, self._fast_frames = loaded, 0
        image = frame.read(loaded)
        decoded = time.monotonic_ns()
        outputs = loaded.engine(image)
        if frame.camera is not None:
            outputs = loaded.rectification(frame.camera).outputs(outputs[None])[0]
        prediction = decode_outputs(outputs)
        end = time.monotonic_ns()
        frame_ms = (end - start) / 1e6
        self._mean_frame_ms += SMOOTHING * (frame_ms - self._mean_frame_ms)
        self._fast_frames = self._fast_frames + 1 if frame_ms <= INLINE_MAX_MS else 0
        return FrameResult(
            prediction,
            loaded.provenance,
            (start - frame.stamp_ns) / 1e6,
            (decoded - start) / 1e6,
            (end - decoded) / 1e6,
        )

    def close(self) -> None:
        """Process the waiting frames, then end the thread."""
        for frames_wait in (True, False):
            self._wake_ups.put(frames_wait)
        self._thread.join()
