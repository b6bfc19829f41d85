"""How the commands of a GPU run are run side by side and stopped."""

import os
import signal
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from benchmarks.gpu import process
from benchmarks.gpu.process import Command, Interrupted


def shell(folder: Path, script: str, name: str = "one") -> Command:
    return Command(("sh", "-c", script), folder / f"{name}.out", folder / f"{name}.log")


def test_commands_run_side_by_side_until_they_end(tmp_path: Path) -> None:
    both = [
        shell(tmp_path, "sleep 0.3; echo a", "a"),
        shell(tmp_path, "sleep 0.3; echo b >&2; exit 3", "b"),
    ]
    begin = time.monotonic()
    ended = process.run(both, 20.0)
    assert time.monotonic() - begin < 10.0
    assert [(each.code, each.stopped) for each in ended] == [(0, False), (3, False)]
    assert all(0.3 <= each.seconds < 10.0 for each in ended)
    assert (tmp_path / "a.out").read_text() == "a\n"
    assert process.log_tail(tmp_path / "b.log") == "b"


POLITE = "trap 'echo saved; exit 7' TERM; echo > {ready}; while :; do sleep 0.05; done"
STUBBORN = "trap '' TERM; echo > {ready}; while :; do sleep 0.05; done"


def test_commands_that_have_done_enough_may_save_and_are_then_killed(tmp_path: Path) -> None:
    ready = [tmp_path / "polite", tmp_path / "stubborn"]
    both = [
        shell(tmp_path, script.format(ready=path), path.name)
        for script, path in zip((POLITE, STUBBORN), ready, strict=True)
    ]
    polite, stubborn = process.run(
        both, 60.0, lambda: all(path.exists() for path in ready), grace_s=1.0
    )
    assert (polite.code, polite.stopped) == (7, True)
    assert (stubborn.code, stubborn.stopped) == (-signal.SIGKILL, True)
    assert (tmp_path / "polite.out").read_text() == "saved\n"


def test_a_command_is_stopped_at_its_deadline(tmp_path: Path) -> None:
    (ended,) = process.run([shell(tmp_path, "sleep 60")], 0.3)
    assert (ended.code, ended.stopped) == (-signal.SIGTERM, True)
    assert 0.3 <= ended.seconds < 30.0


@pytest.fixture
def own_signals() -> Iterator[None]:
    before = {each: signal.getsignal(each) for each in (signal.SIGTERM, signal.SIGINT)}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


@pytest.mark.usefixtures("own_signals")
def test_a_signal_stops_the_commands_too(tmp_path: Path) -> None:
    process.raise_on_signals()
    ready = tmp_path / "ready"

    def enough() -> bool:
        if ready.exists():
            os.kill(os.getpid(), signal.SIGTERM)
        return False

    with pytest.raises(Interrupted) as raised:
        process.run([shell(tmp_path, POLITE.format(ready=ready))], 60.0, enough)
    assert raised.value.args == (signal.SIGTERM,)
    assert (tmp_path / "one.out").read_text() == "saved\n"
