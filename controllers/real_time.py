"""Perception on the wall clock: asked without waiting, used when its answer has come. SI units.

The thread that steps the world also renders (an OpenGL context belongs to one thread); another one
asks the model or the service. While a question is under way the newest image waits for it, and
replaces one that waits. At each control step the newest answer that has come is carried to the
present with the car's own motion. The world keeps to the wall clock: after a control step that took
too long the next ones do not wait until the time is made up.
"""

import math
import time
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Generic, Protocol, Self, TypeVar

import numpy as np

from controllers.closed_loop import RealTimeFigures
from controllers.late_perception import RoadEstimate, check_drop
from controllers.perception import CameraPerception, Perceive, Perceived
from simulator.vehicle.state import CarState
from simulator.world.pace import Pacer

if TYPE_CHECKING:
    from simulator.world.world import World as SimulatedWorld

World = TypeVar("World")
Frame = TypeVar("Frame")
Asked = TypeVar("Asked", contravariant=True)
Answer = TypeVar("Answer")
Clock = Callable[[], float]


@dataclass(frozen=True, slots=True)
class Arrived(Generic[Answer]):
    """An answer, and the control step and the times (s, wall clock) of its question."""

    answer: Answer
    step: int
    asked_s: float
    came_s: float


class Asking(Protocol[Asked, Answer]):
    """What asks for frames: `Asker`, or `AtOnce`."""

    def ask(self, frame: Asked) -> Answer:
        """The answer, waited for."""
        ...

    def put(self, frame: Asked, step: int) -> None:
        """Ask for the frame of a control step, without waiting."""
        ...

    def take(self) -> list[Arrived[Answer]]:
        """The answers that have come since the last call, oldest first."""
        ...

    def close(self) -> None: ...


class AtOnce(Generic[Answer]):
    """For what is known without asking: the frame is the answer."""

    def __init__(self, clock: Clock = time.monotonic) -> None:
        self._clock = clock
        self._arrived: list[Arrived[Answer]] = []

    def ask(self, frame: Answer) -> Answer:
        return frame

    def put(self, frame: Answer, step: int) -> None:
        now = self._clock()
        self._arrived.append(Arrived(frame, step, now, now))

    def take(self) -> list[Arrived[Answer]]:
        arrived, self._arrived = self._arrived, []
        return arrived

    def close(self) -> None:
        """Nothing is held open."""


class Asker(Generic[Frame, Answer]):
    """Asks in a thread of its own, one question at a time; a newer frame replaces a waiting one.

    An error of `ask` is raised by the next `take`.
    """

    def __init__(self, ask: Callable[[Frame], Answer], clock: Clock = time.monotonic) -> None:
        self.ask, self._clock = ask, clock
        self._pool = ThreadPoolExecutor(1, thread_name_prefix="perception")
        self._waiting: deque[tuple[Frame, int, float]] = deque(maxlen=1)
        self._jobs: deque[Future[Arrived[Answer] | None]] = deque()

    def put(self, frame: Frame, step: int) -> None:
        self._waiting.append((frame, step, self._clock()))
        self._jobs.append(self._pool.submit(self._ask_waiting))

    def take(self) -> list[Arrived[Answer]]:
        arrived = []
        while self._jobs and self._jobs[0].done():
            found = self._jobs.popleft().result()
            if found is not None:
                arrived.append(found)
        return arrived

    def close(self) -> None:
        """End the thread, after the question that is under way."""
        self._pool.shutdown(cancel_futures=True)

    def _ask_waiting(self) -> Arrived[Answer] | None:
        if not self._waiting:  # this job's frame was replaced, and the newer one is answered
            return None
        frame, step, asked_s = self._waiting.popleft()
        return Arrived(self.ask(frame), step, asked_s, self._clock())


class RealTimePerception(Generic[World, Frame, Answer]):
    """A perception for `run_lap` that holds the drive to the wall clock. A context manager.

    `capture` takes the frame of the present state, `asking` gets its answer, `read` makes of it
    what the controller receives; `drop` is the share of answers that are lost. The first frame's
    answer is waited for: the clock starts when it is there.
    """

    def __init__(
        self,
        capture: Callable[[World], Frame],
        asking: Asking[Frame, Answer],
        read: Callable[[Answer], Perceived],
        estimate: RoadEstimate,
        *,
        state: Callable[[World], CarState],
        lost: Callable[[], bool] = lambda: False,
        clock: Clock = time.monotonic,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        self._capture, self._asking, self._read = capture, asking, read
        self._estimate, self._state, self._lost = estimate, state, lost
        self._clock = clock
        self._pacer = Pacer(estimate.dt, catch_up_s=math.inf, clock=clock, sleep=sleep)
        self._step = -1
        self._asked_s = 0.0
        """When the newest answer that came was asked for."""
        self._waits_s: list[float] = []
        self._ages_s: list[float] = []
        self._missed = self._lost_answers = 0

    def __call__(self, world: World) -> Perceived:
        """What the controller knows of the road now; waits until the step is due."""
        self._step += 1
        if self._step == 0:
            return self._begin(world)
        self._missed += self._pacer.late
        self._pacer.wait()
        self._asking.put(self._capture(world), self._step)
        newest: Perceived | None = None
        age = 0
        for arrived in self._asking.take():
            self._waits_s.append(arrived.came_s - arrived.asked_s)
            if self._lost():
                self._lost_answers += 1
                continue
            answer = self._read(arrived.answer)
            if answer.to_lane_centre is not None:
                newest, age = answer, self._step - arrived.step
                self._asked_s = arrived.asked_s
        return self._know(world, newest, age)

    def _begin(self, world: World) -> Perceived:
        answer = self._read(self._asking.ask(self._capture(world)))
        self._pacer.restart()
        self._asked_s = self._clock()
        return self._know(world, None if answer.to_lane_centre is None else answer, 0)

    def _know(self, world: World, newest: Perceived | None, age: int) -> Perceived:
        self._estimate.update(self._state(world), newest, age)
        self._ages_s.append(self._clock() - self._asked_s)
        # An answer to the last step's image is in time.
        return self._estimate.present(due=1)

    def figures(self) -> RealTimeFigures:
        """Of the steps so far."""
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
        self._asking.close()


def real_time(
    perceive: Perceive, *, dt: float, drop: float, rng: np.random.Generator
) -> RealTimePerception["SimulatedWorld", Any, Any]:
    """`perceive` on the wall clock; what is no camera and model answers at once."""
    check_drop(drop)

    def lost() -> bool:
        return float(rng.random()) < drop

    estimate = RoadEstimate(dt)
    if isinstance(perceive, CameraPerception):
        return RealTimePerception(
            perceive.capture, Asker(perceive.ask), perceive.read, estimate, state=_state, lost=lost
        )
    return RealTimePerception(perceive, AtOnce(), _as_it_is, estimate, state=_state, lost=lost)


def _state(world: "SimulatedWorld") -> CarState:
    return world.state


def _as_it_is(answer: Perceived) -> Perceived:
    return answer
