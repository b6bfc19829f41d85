"""Pacing by the wall clock, with a fake clock: the tests do not wait."""

import pytest

from simulator.world.pace import MAX_CATCH_UP_S, Pacer, Rate
from trackfeatures.errors import UserError


class Clock:
    def __init__(self) -> None:
        self.now = 100.0
        self.slept: list[float] = []

    def __call__(self) -> float:
        return self.now

    def sleep(self, seconds: float) -> None:
        assert seconds > 0.0
        self.slept.append(seconds)
        self.now += seconds


@pytest.mark.parametrize("speed", [0.5, 1.0, 4.0])
def test_steps_are_paced_at_the_requested_speed(speed: float) -> None:
    clock = Clock()
    pacer = Pacer(0.05, speed, clock=clock, sleep=clock.sleep)
    for _ in range(100):
        clock.now += 0.004  # the work of a step
        pacer.wait()
    assert clock.now - 100.0 == pytest.approx(100 * 0.05 / speed)


def test_a_short_delay_is_caught_up_but_a_long_one_is_not() -> None:
    clock = Clock()
    pacer = Pacer(0.05, clock=clock, sleep=clock.sleep)
    clock.now += 0.17
    assert pacer.late
    for _ in range(10):
        pacer.wait()
    assert clock.now == pytest.approx(100.5)
    clock.now += 20.0
    pacer.wait()
    for _ in range(10):
        pacer.wait()
    assert clock.now == pytest.approx(120.5 + 10 * 0.05, abs=MAX_CATCH_UP_S)
    assert not pacer.late


@pytest.mark.parametrize("speed", [0.0, -1.0, 1e9, float("nan")])
def test_bad_speeds_are_refused(speed: float) -> None:
    with pytest.raises(UserError, match=r"must be 0\.05 to 100"):
        Pacer(0.05, speed)


def test_rate_measures_the_last_seconds_only() -> None:
    clock = Clock()
    rate = Rate(clock)
    assert rate.value == 0.0
    for _ in range(60):
        clock.now += 0.1
        rate.add(0.05)
    assert rate.value == pytest.approx(0.5, rel=0.02)
    for _ in range(60):
        clock.now += 0.05
        rate.add(0.05)
    assert rate.value == pytest.approx(1.0, rel=0.02)
    clock.now += 60.0
    assert rate.value == 0.0
