"""The wall-clock timing of the control steps in real-time mode."""

import time


class RealtimeClock:
    """Ticks `frequency_hz` times a second. A late tick shifts those after it; missed time is not
    made up."""

    def __init__(self, frequency_hz: int) -> None:
        self._period_s = 1.0 / frequency_hz
        self._next = 0.0
        self.restart()

    def restart(self) -> None:
        """The next tick is one period from now."""
        self._next = time.monotonic() + self._period_s

    def wait(self) -> bool:
        """Sleep until the next tick; returns whether it was missed by more than one period."""
        now = time.monotonic()
        late = now > self._next + self._period_s
        if now < self._next:
            time.sleep(self._next - now)
        self._next = (now if late else self._next) + self._period_s
        return late
