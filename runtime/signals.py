"""Ends of a loop by a signal."""

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType


@contextmanager
def interrupts(*numbers: int) -> Iterator[Callable[[], bool]]:
    """A function that returns whether one of these signals arrived, for a loop to check.

    A KeyboardInterrupt raised inside a callback, a finaliser or an extension module may be lost:
    numpy discards one raised while it compares a scalar with an IntEnum. A second signal is raised
    as KeyboardInterrupt. Other threads than the main one receive no signals.
    """
    seen: list[int] = []
    if threading.current_thread() is not threading.main_thread():
        yield lambda: False
        return

    def note(number: int, _frame: FrameType | None) -> None:
        seen.append(number)
        signal.signal(number, signal.default_int_handler)

    before = {number: signal.signal(number, note) for number in numbers}
    try:
        yield lambda: bool(seen)
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
