"""Runs the commands of a stage in parallel until a deadline, then stops the commands that still
run."""

import os
import signal
import subprocess
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import FrameType

GRACE_S = 12.0
"""Time (s) from SIGTERM to SIGKILL. In this time a training saves a checkpoint, or a collection the
list of its rounds."""
POLL_S = 0.1
LOG_LINES = 30


class Interrupted(BaseException):
    """The run received SIGTERM or SIGINT; the argument is the signal's number."""


@dataclass(frozen=True)
class Command:
    """A program with its arguments, the files for stdout (`out`) and stderr (`log`), and
    environment variables that are added to those of this process."""

    words: tuple[str, ...]
    out: Path
    log: Path
    environment: Mapping[str, str] | None = None


@dataclass(frozen=True)
class Ended:
    """How a command ended: its exit code, and whether it was stopped before it ended by itself."""

    code: int
    stopped: bool
    seconds: float


def run(
    commands: Sequence[Command],
    seconds: float,
    enough: Callable[[], bool] = lambda: False,
    grace_s: float = GRACE_S,
) -> list[Ended]:
    """Run `commands` in parallel for at most `seconds`, or until `enough()` is true.

    Commands that still run at this moment get SIGTERM. After `grace_s` (s) they get SIGKILL, with
    all their child processes. Commands are stopped in the same way when this process is
    interrupted.
    """
    begin = time.monotonic()
    running = [_start(command) for command in commands]
    ends: dict[int, float] = {}
    try:
        while time.monotonic() - begin < seconds and not enough():
            for number, process in enumerate(running):
                if process.poll() is not None:
                    ends.setdefault(number, time.monotonic())
            if len(ends) == len(running):
                break
            time.sleep(POLL_S)
    finally:
        stopped = [process.poll() is None for process in running]
        _stop(running, grace_s)
    last = time.monotonic()
    return [
        Ended(process.returncode, stopped[number], round(ends.get(number, last) - begin, 3))
        for number, process in enumerate(running)
    ]


def _start(command: Command) -> subprocess.Popen[bytes]:
    command.log.parent.mkdir(parents=True, exist_ok=True)
    environment = {**os.environ, **(command.environment or {})}
    with command.out.open("wb") as out, command.log.open("ab") as log:
        return subprocess.Popen(
            command.words, stdout=out, stderr=log, env=environment, process_group=0
        )


def _stop(running: Sequence[subprocess.Popen[bytes]], grace_s: float) -> None:
    """End the running processes. Only these can have child processes, because the commands of this
    project wait for their child processes before they end."""
    left = [process for process in running if process.poll() is None]
    for process in left:
        process.terminate()
    until = time.monotonic() + grace_s
    for process in left:
        try:
            process.wait(max(until - time.monotonic(), 0.0))
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()


def log_tail(log: Path) -> str:
    """Return the last lines of the file `log`, without the intermediate states of progress bars."""
    text = log.read_text(errors="replace") if log.is_file() else ""
    lines = [line.rsplit("\r", 1)[-1].rstrip() for line in text.splitlines()]
    return "\n".join([line for line in lines if line][-LOG_LINES:])


def raise_on_signals() -> None:
    """Let the first SIGTERM or SIGINT raise Interrupted in the main thread; ignore later ones."""

    def interrupt(number: int, frame: FrameType | None) -> None:
        for each in (signal.SIGTERM, signal.SIGINT):
            signal.signal(each, signal.SIG_IGN)
        raise Interrupted(number)

    for each in (signal.SIGTERM, signal.SIGINT):
        signal.signal(each, interrupt)
