"""Keeping simulated time level with the clock, and saying honestly how well that works."""

import time
from collections import deque
from collections.abc import Callable
from typing import Final

from trackfeatures.errors import UserError

SPEEDS: Final = (0.05, 100.0)
FORGIVEN_S: Final = 0.25
"""Farther behind than this, a drive does not race to catch up."""
WINDOW_S: Final = 1.5
"""Time over which a rate is measured."""


def check_speed(speed: float) -> None:
    """Raises UserError for a speed (times real time) that is none."""
    if not SPEEDS[0] <= speed <= SPEEDS[1]:
        raise UserError(
            f"a speed of {speed:g} times real time was asked for; it must be "
            f"{SPEEDS[0]:g} to {SPEEDS[1]:g}"
        )


class Rate:
    """How much of something there was a second of the clock, lately."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._marks: deque[tuple[float, float]] = deque()
        self._sum = 0.0

    def add(self, amount: float) -> None:
        """Something happened now."""
        now = self._clock()
        self._sum += amount
        self._marks.append((now, self._sum))
        while now - self._marks[0][0] > WINDOW_S:
            self._marks.popleft()

    @property
    def value(self) -> float:
        """A second of the clock; 0 while there is nothing to measure."""
        if len(self._marks) < 2:
            return 0.0
        first, before = self._marks[0]
        elapsed = max(self._clock() - first, 1e-6)
        return (self._sum - before) / elapsed if elapsed < 2.0 * WINDOW_S else 0.0


class Pacer:
    """Lets one step of `step_s` simulated seconds pass every `step_s / speed` of the clock."""

    def __init__(
        self,
        step_s: float,
        speed: float = 1.0,
        *,
        clock: Callable[[], float] = time.monotonic,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        check_speed(speed)
        self._interval = step_s / speed
        self._clock, self._sleep = clock, sleep
        self._due = clock() + self._interval

    @property
    def late(self) -> bool:
        """Whether the next step is overdue: no time for what can be left out."""
        return self._clock() > self._due

    def wait(self) -> None:
        """Sleep until the next step is due."""
        ahead = self._due - self._clock()
        if ahead > 0.0:
            self._sleep(ahead)
        elif ahead < -FORGIVEN_S:
            self._due = self._clock()
        self._due += self._interval
