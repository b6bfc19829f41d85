"""Lets a loop end after a signal, between two iterations."""

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType


@contextmanager
def interrupts(*numbers: int) -> Iterator[Callable[[], bool]]:
    """Yield a function that returns whether one of the signals `numbers` has arrived. A loop calls
    the function between two iterations.

    The first signal raises no KeyboardInterrupt, because an interrupt that is raised inside a
    callback, a finaliser or an extension module can be lost: numpy discards a KeyboardInterrupt
    that is raised while it compares a scalar with an IntEnum. The same signal raises
    KeyboardInterrupt when it arrives a second time. Only the main thread can receive signals; in
    another thread the function always returns False.
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
