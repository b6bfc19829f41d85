"""A loop ends after a signal, between two steps."""

import signal
import threading
import time
from enum import IntEnum

import numpy as np
import pytest

from runtime.signals import interrupts


class Kind(IntEnum):
    FIRST = 1


def test_a_signal_is_noted_wherever_it_arrives() -> None:
    """numpy discards an exception that is raised while it compares a scalar with an IntEnum."""
    before = signal.getsignal(signal.SIGALRM)
    with interrupts(signal.SIGALRM) as interrupted:
        signal.setitimer(signal.ITIMER_REAL, 0.001)
        end = time.monotonic() + 60.0
        while not interrupted():
            assert np.uint32(2) != Kind.FIRST
            assert time.monotonic() < end
    assert signal.getsignal(signal.SIGALRM) == before


def test_a_second_signal_is_raised() -> None:
    with interrupts(signal.SIGUSR1) as interrupted:
        assert not interrupted()
        signal.raise_signal(signal.SIGUSR1)
        assert interrupted()
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGUSR1)


def test_another_thread_is_not_interrupted() -> None:
    answers = []

    def check() -> None:
        with interrupts(signal.SIGINT) as interrupted:
            answers.append(interrupted())

    thread = threading.Thread(target=check)
    thread.start()
    thread.join()
    assert answers == [False]
