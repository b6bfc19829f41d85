"""Asynchronous perception in real time: a control step uses the newest received answer. SI units.

The thread that steps the world also renders, because an OpenGL context belongs to one thread. A
second thread sends requests to the model or the service, one at a time. During a request only the
newest image waits. At each control step the newest answer is predicted to the present from the
car's own motion. The world follows the wall clock: after a control step that took too long, the
next steps begin at once until the delay is made up.
"""

import math
import time
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from operator import attrgetter
from typing import TYPE_CHECKING, Any, Generic, Protocol, Self, TypeVar

import numpy as np

from controllers.perception.late import RoadEstimate, check_drop
from controllers.perception.perceived import Perceive, Perceived
from controllers.perception.sources import CameraPerception
from simulator.vehicle.state import CarState
from simulator.world.pace import Pacer

if TYPE_CHECKING:
    from simulator.world.world import World as SimulatedWorld

World = TypeVar("World")
Frame = TypeVar("Frame")
Request = TypeVar("Request", contravariant=True)
Answer = TypeVar("Answer")
Clock = Callable[[], float]


@dataclass(frozen=True, slots=True)
class TimedAnswer(Generic[Answer]):
    """An answer, the control step of its image, and the times (s) of request and receipt."""

    answer: Answer
    step: int
    requested_s: float
    received_s: float


class AnswerSource(Protocol[Request, Answer]):
    """The source of the answers to frames: `RequestThread` or `ImmediateAnswers`."""

    def ask(self, frame: Request) -> Answer:
        """Return the answer to `frame`; waits for it."""

    def put(self, frame: Request, step: int) -> None:
        """Request the answer to the frame of a control step, without waiting."""

    def take(self) -> list[TimedAnswer[Answer]]:
        """Return the answers received since the last call, oldest first."""

    def close(self) -> None:
        """End the source's thread, if it has one."""


class ImmediateAnswers(Generic[Answer]):
    """An `AnswerSource` for a perception that needs no requests: each frame is its own answer."""

    def __init__(self, clock: Clock = time.monotonic) -> None:
        self._clock = clock
        self._answers: list[TimedAnswer[Answer]] = []

    def ask(self, frame: Answer) -> Answer:
        return frame

    def put(self, frame: Answer, step: int) -> None:
        now = self._clock()
        self._answers.append(TimedAnswer(frame, step, now, now))

    def take(self) -> list[TimedAnswer[Answer]]:
        answers, self._answers = self._answers, []
        return answers

    def close(self) -> None:
        """Do nothing: the source has no thread."""


class RequestThread(Generic[Frame, Answer]):
    """A thread that requests answers, one at a time. Only one frame waits for its request: a newer
    frame replaces it.

    An error that `ask` raises in the thread is raised by the next call of `take`.
    """

    def __init__(self, ask: Callable[[Frame], Answer], clock: Clock = time.monotonic) -> None:
        self.ask, self._clock = ask, clock
        self._pool = ThreadPoolExecutor(1, thread_name_prefix="perception")
        self._waiting: deque[tuple[Frame, int, float]] = deque(maxlen=1)
        self._jobs: deque[Future[TimedAnswer[Answer] | None]] = deque()

    def put(self, frame: Frame, step: int) -> None:
        self._waiting.append((frame, step, self._clock()))
        self._jobs.append(self._pool.submit(self._ask_waiting))

    def take(self) -> list[TimedAnswer[Answer]]:
        answers = []
        while self._jobs and self._jobs[0].done():
            found = self._jobs.popleft().result()
            if found is not None:
                answers.append(found)
        return answers

    def close(self) -> None:
        """End the thread after its present request."""
        self._pool.shutdown(cancel_futures=True)

    def _ask_waiting(self) -> TimedAnswer[Answer] | None:
        if not self._waiting:  # an earlier job has answered the frame that replaced this job's
            return None
        frame, step, requested_s = self._waiting.popleft()
        return TimedAnswer(self.ask(frame), step, requested_s, self._clock())


@dataclass(frozen=True, slots=True)
class RealTimeFigures:
    """Times of the answers and of the control steps of a drive in real time."""

    late_answers: int
    """Number of answers that took longer than a control step."""
    lost_answers: int
    """Number of answers that were dropped on purpose (option --drop)."""
    answer_ms_median: float
    """Median time (ms) from an image to its answer. `answer_ms_p99` is the 99th percentile."""
    answer_ms_p99: float
    age_ms_median: float
    """Median over the control steps of the age (ms) of the newest answer, counted from its image.
    `age_ms_p99` is the 99th percentile."""
    age_ms_p99: float
    missed_steps: int
    """Number of control steps that took longer than their 50 ms, or began late because an earlier
    step took too long."""


class RealTimePerception(Generic[World, Frame, Answer]):
    """A perception for `run_lap` that keeps the drive in real time; use it as a context manager.

    `capture` renders the frame of the present state, `source` answers it, and `read` converts the
    answer for the controller. `lost` decides for each answer whether it is lost. The clock starts
    with the answer to the first frame.
    """

    def __init__(
        self,
        capture: Callable[[World], Frame],
        source: AnswerSource[Frame, Answer],
        read: Callable[[Answer], Perceived],
        estimate: RoadEstimate,
        *,
        state: Callable[[World], CarState],
        lost: Callable[[], bool] = lambda: False,
        clock: Clock = time.monotonic,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        self._capture, self._source, self._read = capture, source, read
        self._estimate, self._state, self._lost = estimate, state, lost
        self._clock = clock
        self._pacer = Pacer(estimate.dt, catch_up_s=math.inf, clock=clock, sleep=sleep)
        self._step = -1
        self._requested_s = 0.0
        """Time of the request of the newest received answer."""
        self._waits_s: list[float] = []
        self._ages_s: list[float] = []
        self._missed = self._lost_answers = 0

    def __call__(self, world: World) -> Perceived:
        """Wait until the control step is due; returns the estimate of the road."""
        self._step += 1
        if self._step == 0:
            return self._begin(world)
        self._missed += self._pacer.late
        self._pacer.wait()
        self._source.put(self._capture(world), self._step)
        newest: Perceived | None = None
        age = 0
        for received in self._source.take():
            self._waits_s.append(received.received_s - received.requested_s)
            if self._lost():
                self._lost_answers += 1
                continue
            answer = self._read(received.answer)
            if answer.to_lane_centre is not None:
                newest, age = answer, self._step - received.step
                self._requested_s = received.requested_s
        return self._know(world, newest, age)

    def _begin(self, world: World) -> Perceived:
        answer = self._read(self._source.ask(self._capture(world)))
        self._pacer.restart()
        self._requested_s = self._clock()
        return self._know(world, None if answer.to_lane_centre is None else answer, 0)

    def _know(self, world: World, newest: Perceived | None, age: int) -> Perceived:
        self._estimate.update(self._state(world), newest, age)
        self._ages_s.append(self._clock() - self._requested_s)
        # An answer to the image of the preceding control step is not late.
        return self._estimate.present(due=1)

    def figures(self) -> RealTimeFigures:
        """Return the figures of all control steps so far."""
        waits_ms = 1000.0 * np.array(self._waits_s or [0.0])
        ages_ms = 1000.0 * np.array(self._ages_s or [0.0])
        return RealTimeFigures(
            late_answers=sum(wait > self._estimate.dt for wait in self._waits_s),
            lost_answers=self._lost_answers,
            answer_ms_median=float(np.median(waits_ms)),
            answer_ms_p99=float(np.percentile(waits_ms, 99)),
            age_ms_median=float(np.median(ages_ms)),
            age_ms_p99=float(np.percentile(ages_ms, 99)),
            missed_steps=self._missed,
        )

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._source.close()


def real_time(
    perceive: Perceive, *, dt: float, drop: float, rng: np.random.Generator
) -> RealTimePerception["SimulatedWorld", Any, Any]:
    """Return a perception that calls `perceive` in real time, once for each control step of `dt` s.

    A share `drop` of the answers, random by `rng`, is lost. Only a perception with a camera takes
    time to answer. Raises UserError unless `drop` is at least 0 and below 1.
    """
    check_drop(drop)

    def lost() -> bool:
        return float(rng.random()) < drop

    estimate = RoadEstimate(dt)
    if isinstance(perceive, CameraPerception):
        return RealTimePerception(
            perceive.capture,
            RequestThread(perceive.ask),
            perceive.read,
            estimate,
            state=attrgetter("state"),
            lost=lost,
        )
    return RealTimePerception(
        perceive,
        ImmediateAnswers(),
        lambda answer: answer,
        estimate,
        state=attrgetter("state"),
        lost=lost,
    )
