"""Drives in real time with delayed answers, on a simulated clock."""

import math
import threading
from collections.abc import Callable
from dataclasses import replace

import pytest

from controllers.drive.config import DriveConfig
from controllers.drive.run import drive
from controllers.perception.late import RoadEstimate
from controllers.perception.perceived import Perceive, Perceived
from controllers.perception.real_time import (
    AnswerSource,
    ImmediateAnswers,
    RealTimePerception,
    RequestThread,
    TimedAnswer,
)
from controllers.perception.sources import truth
from simulator.world.world import World
from tests.controllers.fake_world import Straight, at_rest
from trackfeatures import RoadClass, UserError

DT = 0.05


class Clock:
    """A clock whose time passes only in `sleep`, and when a test adds to `now`."""

    def __init__(self) -> None:
        self.now = 100.0

    def __call__(self) -> float:
        return self.now

    def sleep(self, seconds: float) -> None:
        assert seconds >= 0.0
        self.now += seconds


class SlowModel:
    """Answers requests one at a time, the newest first; a request takes `seconds`."""

    def __init__(self, clock: Clock, *seconds: float) -> None:
        self._clock, self._seconds = clock, list(seconds)
        self._under_way: list[tuple[float, TimedAnswer[Perceived]]] = []
        self._waiting: tuple[Perceived, int, float] | None = None
        self._free_s = 0.0
        self.closed = False

    def ask(self, frame: Perceived) -> Perceived:
        return frame

    def put(self, frame: Perceived, step: int) -> None:
        self._start()
        self._waiting = (frame, step, self._clock())

    def take(self) -> list[TimedAnswer[Perceived]]:
        self._start()
        due = [one for at, one in self._under_way if at <= self._clock()]
        self._under_way = [pair for pair in self._under_way if pair[1] not in due]
        return due

    def close(self) -> None:
        self.closed = True

    def _start(self) -> None:
        if self._waiting is None or self._free_s > self._clock():
            return
        (frame, step, asked), self._waiting = self._waiting, None
        takes = self._seconds.pop(0) if len(self._seconds) > 1 else self._seconds[0]
        self._free_s = max(asked, self._free_s) + takes
        self._under_way.append((self._free_s, TimedAnswer(frame, step, asked, self._free_s)))


def live(
    clock: Clock,
    source: AnswerSource[Perceived, Perceived],
    capture: Callable[[Straight], Perceived] = Straight.perceive,
    lost: Callable[[], bool] = lambda: False,
) -> RealTimePerception[Straight, Perceived, Perceived]:
    return RealTimePerception(
        capture,
        source,
        lambda answer: answer,
        RoadEstimate(DT),
        state=lambda car: at_rest(vx=car.speed),
        lost=lost,
        clock=clock,
        sleep=clock.sleep,
    )


@pytest.mark.parametrize(
    ("seconds", "late", "answer_ms", "age_ms"),
    [
        (0.01, 0, (10.0, 10.0), (50.0, 50.0)),
        (0.049, 0, (49.0, 49.0), (50.0, 50.0)),
        # 24 answers, one after the other, in the 2.9 s since the first image in motion. An image
        # waits up to a step, its answer waits up to a step, and until the next it ages by 120 ms.
        (0.12, 24, (120.0, 170.0), (150.0, 300.0)),
    ],
)
def test_the_newest_answer_is_carried_to_the_present(
    seconds: float, late: int, answer_ms: tuple[float, float], age_ms: tuple[float, float]
) -> None:
    clock, car = Clock(), Straight()
    with live(clock, SlowModel(clock, seconds)) as perceive:
        for car.step in range(60):
            known = perceive(car)
            assert known.to_lane_centre == pytest.approx(car.offset, abs=1e-9)
            assert known.angle == pytest.approx(car.angle)
            assert clock.now == pytest.approx(100.0 + DT * car.step)
    figures = perceive.figures()
    assert (figures.late_answers, figures.missed_steps) == (late, 0)
    least, most = answer_ms
    assert least - 0.01 <= figures.answer_ms_median <= figures.answer_ms_p99 <= most + 0.01
    least, most = age_ms
    assert least - 0.01 <= figures.age_ms_median <= figures.age_ms_p99 <= most + 0.01


def test_an_answer_that_does_not_come_leaves_the_perception_lost() -> None:
    clock, car = Clock(), Straight()
    perceive = live(clock, SlowModel(clock, 1e9))
    for car.step in range(30):
        known = perceive(car)
        waited = max(car.step - 1, 0) * DT
        assert known.lost_s == pytest.approx(waited)
        assert (known.to_lane_centre is None) is (waited > 1.0 + 1e-9)
    assert perceive.figures().age_ms_p99 == pytest.approx(1450.0, rel=0.02)


def test_lost_answers_stay_lost() -> None:
    clock, car, asked = Clock(), Straight(), 0

    def lost() -> bool:
        nonlocal asked
        asked += 1
        return asked % 2 == 0

    perceive = live(clock, ImmediateAnswers(clock), lost=lost)
    for car.step in range(21):
        assert perceive(car).to_lane_centre == pytest.approx(car.offset, abs=1e-9)
    figures = perceive.figures()
    assert figures.lost_answers == 10
    assert (figures.late_answers, figures.age_ms_median) == (0, 0.0)
    assert figures.age_ms_p99 == pytest.approx(50.0)


def test_slow_control_steps_are_counted_and_made_up() -> None:
    clock, car = Clock(), Straight()
    perceive = live(clock, SlowModel(clock, 0.01))
    for car.step in range(10):
        perceive(car)
        clock.now += 0.12 if car.step == 3 else 0.02  # the control of this step
    # Step 3 took from 0.15 s to 0.27 s and step 4 to 0.29 s; both ended late. The delay is made up
    # at 0.31 s, the end of step 5.
    assert perceive.figures().missed_steps == 3
    assert clock.now == pytest.approx(100.0 + 9 * DT + 0.02)


def test_only_the_newest_waiting_frame_is_requested() -> None:
    begun, go_on = threading.Semaphore(0), threading.Semaphore(0)

    def ask(frame: str) -> str:
        begun.release()
        assert go_on.acquire(timeout=60)
        return frame.upper()

    requests = RequestThread(ask)
    requests.put("a", 0)
    assert begun.acquire(timeout=60)  # "a" is under way
    for step, frame in enumerate("bcd", start=1):
        requests.put(frame, step)
    assert requests.take() == []
    go_on.release(2)
    assert begun.acquire(timeout=60)
    requests._pool.submit(int).result(timeout=60)  # all jobs before this one are done
    assert [(one.answer, one.step) for one in requests.take()] == [("A", 0), ("D", 3)]
    requests.close()


def test_an_error_of_a_request_is_raised_in_the_drive() -> None:
    def ask(frame: int) -> int:
        raise UserError("the service does not answer")

    requests = RequestThread(ask)
    requests.put(1, 0)
    requests._pool.submit(int).result(timeout=60)
    with pytest.raises(UserError, match="does not answer"):
        requests.take()
    requests.close()


def test_a_drive_on_the_truth_in_real_time_has_the_same_result() -> None:
    config = DriveConfig(controller="lqr", steps=12, start_d=0.5)
    simulated = drive(config)
    result = drive(replace(config, realtime=True))
    assert result.real_time is not None
    assert replace(result, real_time=None) == simulated
    assert "late_answers" not in simulated.as_json()
    assert "real_time" not in result.as_json()
    assert {"late_answers", "missed_steps", "age_ms_p99"} <= set(result.as_json())


def test_a_service_that_fails_ends_the_drive(perceive_by: Callable[[Perceive], None]) -> None:
    exact = truth(0.0)

    def perceive(world: World) -> Perceived:
        if world.state.time_s > 0.2:
            raise UserError("the service does not answer")
        return exact(world)

    perceive_by(perceive)
    with pytest.raises(UserError, match="does not answer"):
        drive(DriveConfig(steps=10, realtime=True))


def test_a_blind_answer_is_no_answer() -> None:
    clock, car = Clock(), Straight()
    blind = Perceived(None, 0.0, RoadClass.STRAIGHT)
    perceive = live(
        clock, ImmediateAnswers(clock), lambda car: blind if car.step == 5 else car.perceive()
    )
    for car.step in range(7):
        known = perceive(car)
        assert known.to_lane_centre == pytest.approx(car.offset, abs=1e-9)
        assert math.isclose(known.lost_s, 0.0)
