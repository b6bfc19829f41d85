"""A command closes its files after a signal; a loop ends between two steps."""

import signal
import threading
import time
from contextlib import ExitStack
from enum import IntEnum

import numpy as np
import pytest

from runtime.signals import ENDING, ended_by_signals, interrupts


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


def test_a_loop_ends_when_its_terminal_is_closed_but_not_under_nohup() -> None:
    before = signal.signal(signal.SIGHUP, signal.SIG_DFL)
    try:
        with interrupts(signal.SIGHUP) as interrupted:
            signal.raise_signal(signal.SIGHUP)
            signal.raise_signal(signal.SIGHUP)  # a closing terminal sends two
            assert interrupted()
        assert signal.signal(signal.SIGHUP, signal.SIG_IGN) == signal.SIG_DFL
        with interrupts(signal.SIGHUP) as interrupted:
            signal.raise_signal(signal.SIGHUP)
            assert not interrupted()
        assert signal.getsignal(signal.SIGHUP) == signal.SIG_IGN
    finally:
        signal.signal(signal.SIGHUP, before)


def test_another_thread_is_not_interrupted() -> None:
    answers = []

    def check() -> None:
        with interrupts(signal.SIGINT) as interrupted:
            answers.append(interrupted())

    thread = threading.Thread(target=check)
    thread.start()
    thread.join()
    assert answers == [False]


@pytest.mark.parametrize("number", ENDING)
def test_a_command_is_interrupted_once_and_its_files_are_closed(number: signal.Signals) -> None:
    before = {each: signal.signal(each, signal.SIG_DFL) for each in ENDING}
    closed: list[str] = []

    def command() -> None:
        with ended_by_signals(), ExitStack() as files:
            files.callback(closed.append, "film")
            files.callback(signal.raise_signal, signal.SIGHUP)  # a closing terminal sends two
            signal.raise_signal(number)

    with pytest.raises(KeyboardInterrupt):
        command()
    assert closed == ["film"]
    for each, handler in before.items():
        assert signal.signal(each, handler) == signal.SIG_DFL


def test_a_signal_whose_interrupt_was_lost_is_raised_again(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("runtime.signals.REPEAT_S", 0.0)
    with ended_by_signals():
        for _ in range(2):
            with pytest.raises(KeyboardInterrupt):
                signal.raise_signal(signal.SIGTERM)


def test_a_signal_that_nohup_ignores_stays_ignored() -> None:
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with ended_by_signals():
            signal.raise_signal(signal.SIGHUP)
        assert signal.getsignal(signal.SIGHUP) == signal.SIG_IGN
    finally:
        signal.signal(signal.SIGHUP, before)
