"""Lets a command end in order after a signal, and a loop between two iterations."""

import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType

ENDING = (signal.SIGTERM, signal.SIGHUP)
"""Signals of `kill`, of service managers and of a terminal that is closed."""
REPEAT_S = 5.0
"""Time (s) after a signal in which further signals are ignored: a shell whose terminal is closed
sends a second SIGHUP, which must not interrupt the closing of files."""


@contextmanager
def ended_by_signals() -> Iterator[None]:
    """Within the block, let SIGTERM and SIGHUP raise KeyboardInterrupt, as Ctrl-C does, so that
    files are closed.

    A signal that is ignored at the start of the block stays ignored, for example SIGHUP under
    `nohup`. Only the main thread can receive signals; in another thread the block has no effect.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    ignored_until = 0.0

    def end(_number: int, _frame: FrameType | None) -> None:
        nonlocal ignored_until
        now = time.monotonic()
        if now >= ignored_until:
            ignored_until = now + REPEAT_S
            raise KeyboardInterrupt

    before = {number: signal.getsignal(number) for number in ENDING}
    for number, handler in before.items():
        if handler is not signal.SIG_IGN:
            signal.signal(number, end)
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@contextmanager
def interrupts(*numbers: int) -> Iterator[Callable[[], bool]]:
    """Yield a function that returns whether one of the signals `numbers` has arrived. A loop calls
    the function between two iterations.

    The first signal raises no KeyboardInterrupt, because an interrupt that is raised inside a
    callback, a finaliser or an extension module can be lost: numpy discards a KeyboardInterrupt
    that is raised while it compares a scalar with an IntEnum. The same signal raises
    KeyboardInterrupt when it arrives a second time, except SIGHUP, which a closing terminal sends
    twice. SIGHUP stays ignored under `nohup`. Only the main thread can receive signals; in another
    thread the function always returns False.
    """
    seen: list[int] = []
    if threading.current_thread() is not threading.main_thread():
        yield lambda: False
        return

    def note(number: int, _frame: FrameType | None) -> None:
        seen.append(number)
        again = signal.SIG_IGN if number == signal.SIGHUP else signal.default_int_handler
        signal.signal(number, again)

    before = {
        number: signal.signal(number, note)
        for number in numbers
        if number != signal.SIGHUP or signal.getsignal(number) != signal.SIG_IGN
    }
    try:
        yield lambda: bool(seen)
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
