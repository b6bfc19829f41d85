"""Paces simulated time by the wall clock, and measures the rate reached."""

import time
from collections import deque
from collections.abc import Callable
from typing import Final

from trackfeatures.errors import UserError

SPEEDS: Final = (0.05, 100.0)
MAX_CATCH_UP_S: Final = 0.25
"""Longest delay (s) of a watched drive that later steps make up. Longer delays are not made up."""
WINDOW_S: Final = 1.5
"""Length of the time window (s) in which a rate is measured."""


def check_speed(speed: float) -> None:
    """Raises UserError unless `speed`, a multiple of real time, is in its range."""
    if not SPEEDS[0] <= speed <= SPEEDS[1]:
        raise UserError(
            f"a speed of {speed:g} times real time was asked for; it must be "
            f"{SPEEDS[0]:g} to {SPEEDS[1]:g}"
        )


class Rate:
    """Measures an amount per second of wall-clock time, over the last 1.5 s."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._marks: deque[tuple[float, float]] = deque()
        self._sum = 0.0

    def add(self, amount: float) -> None:
        """Add an amount at the current time."""
        now = self._clock()
        self._sum += amount
        self._marks.append((now, self._sum))
        while now - self._marks[0][0] > WINDOW_S:
            self._marks.popleft()

    @property
    def value(self) -> float:
        """Amount per second; 0 if the window contains fewer than two amounts, or if its oldest
        amount was added 3 s ago or earlier."""
        if len(self._marks) < 2:
            return 0.0
        first, before = self._marks[0]
        elapsed = max(self._clock() - first, 1e-6)
        return (self._sum - before) / elapsed if elapsed < 2.0 * WINDOW_S else 0.0


class Pacer:
    """Paces steps of `step_s` simulated seconds to one per `step_s / speed` wall-clock seconds."""

    def __init__(
        self,
        step_s: float,
        speed: float = 1.0,
        *,
        catch_up_s: float = MAX_CATCH_UP_S,
        clock: Callable[[], float] = time.monotonic,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        check_speed(speed)
        self._interval = step_s / speed
        self._catch_up_s = catch_up_s
        self._clock, self._sleep = clock, sleep
        self.restart()

    def restart(self) -> None:
        """Restart the timing: the next step is due one interval from now."""
        self._due = self._clock() + self._interval

    @property
    def late(self) -> bool:
        """Whether the next step is overdue, so that optional work should be skipped."""
        return self._clock() > self._due

    def wait(self) -> bool:
        """Sleep until the next step is due. Returns True if the step is overdue by more than
        `catch_up_s`; the steps after it then do not make up the delay."""
        ahead = self._due - self._clock()
        late = ahead < -self._catch_up_s
        if ahead > 0.0:
            self._sleep(ahead)
        elif late:
            self._due = self._clock()
        self._due += self._interval
        return late
