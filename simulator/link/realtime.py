"""Keeps the engine's control steps to the wall clock."""

import time


class Clock:
    """Ticks `frequency_hz` times a second. A tick that comes late moves those after it: nothing is
    caught up on."""

    def __init__(self, frequency_hz: int) -> None:
        self._period_s = 1.0 / frequency_hz
        self._next = 0.0
        self.restart()

    def restart(self) -> None:
        """The next tick is one period from now."""
        self._next = time.monotonic() + self._period_s

    def wait(self) -> bool:
        """Sleep until the tick; whether it was missed by more than a period."""
        now = time.monotonic()
        late = now > self._next + self._period_s
        if now < self._next:
            time.sleep(self._next - now)
        self._next = (now if late else self._next) + self._period_s
        return late
