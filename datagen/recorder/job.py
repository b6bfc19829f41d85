"""Records one round, checks it and moves it atomically into a dataset folder.

Recording processes on this machine (`worker_main`) and Ray actors use this module.
"""

import ctypes
import os
import signal
import sys
import traceback
from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from multiprocessing.connection import Connection
from pathlib import Path
from typing import TYPE_CHECKING

from datagen.errors import RoundFailed
from datagen.planning.plan import RoundPlan
from datagen.recording.folder import (
    RoundState,
    discard_partial,
    partial_path,
    publish,
)
from datagen.recording.integrity.round_checks import check_round
from datagen.recording.mcap.index import open_round
from simulator.world.errors import ContactsUnavailable
from trackfeatures.errors import UserError

if TYPE_CHECKING:
    from datagen.recorder.record import MakeLaw

REPORT_EVERY = 10  # frames
PR_SET_PDEATHSIG = 1  # <linux/prctl.h>


@dataclass(frozen=True, slots=True)
class Job:
    """A round to record: its plan entry, the dataset folder, and a further folder in which tracks
    are searched."""

    plan: RoundPlan
    plan_hash: str
    folder: Path
    tracks_dir: Path | None
    make_law: "MakeLaw | None" = None
    """Makes the steering law that replaces the scripted driver's; it must be picklable."""


@dataclass(frozen=True, slots=True)
class FramesDone:
    """Message from a recording process: the number of frames recorded so far. It is also a
    heartbeat: `datagen.execution.retry` sets the time after which a silent process is stopped."""

    round_id: str
    frames: int


@dataclass(frozen=True, slots=True)
class RoundDone:
    """Outcome: the round is in the dataset folder. `resets` is the number of times that the car was
    reset onto the road in this round."""

    state: RoundState
    resets: int


@dataclass(frozen=True, slots=True)
class AttemptFailed:
    """Outcome: the attempt to record this round failed. Another attempt may succeed, unless `final`
    is true."""

    round_id: str
    reason: str
    final: bool = False


@dataclass(frozen=True, slots=True)
class FatalError:
    """Outcome: an error that would stop every round, such as a full disk. The collection raises
    it."""

    error: UserError | OSError


Outcome = RoundDone | AttemptFailed | FatalError
Message = FramesDone | Outcome
Report = Callable[[FramesDone], None]


def attempt(job: Job, report: Report) -> Outcome:
    """Try to record a round and return the outcome. Errors become outcomes, except BrokenPipeError,
    which `report` raises if the collector has ended."""
    try:
        return record_and_publish(job, report)
    except BrokenPipeError:
        raise
    except (RoundFailed, ContactsUnavailable) as error:
        return AttemptFailed(job.plan.id, str(error), final=True)
    except (UserError, OSError) as error:
        return FatalError(_portable(error, job.folder))
    except Exception as error:  # noqa: BLE001  # any other error fails this round only
        traceback.print_exc()
        return AttemptFailed(job.plan.id, f"{type(error).__name__}: {error}")


def record_and_publish(job: Job, report: Report = lambda message: None) -> RoundDone:
    """Record one round, check the file, and move it into the dataset folder. `report` is called
    after every 10 frames (REPORT_EVERY) and at the end."""
    # Imported here: the parent process imports this module and needs no physics or graphics.
    from datagen.recorder.record import record_round

    def progress(frames: int) -> None:
        if frames % REPORT_EVERY == 0:
            report(FramesDone(job.plan.id, frames))

    partial = partial_path(job.folder, job.plan.id)
    try:
        record_round(job.plan, job.plan_hash, partial, job.tracks_dir, progress, job.make_law)
        report(FramesDone(job.plan.id, job.plan.frames))
        state, resets = _check_recorded(partial)
        publish(job.folder, partial, state)
    finally:
        discard_partial(job.folder, job.plan.id)
    return RoundDone(state, resets)


def _check_recorded(partial: Path) -> tuple[RoundState, int]:
    """Read the recorded file `partial`; return the state of its round and the number of resets in
    the round. Raises RuntimeError if the file is damaged."""
    index = open_round(partial)
    state = RoundState.of(partial, index.header, index.result)
    _, problems = check_round(partial, "full", state)
    if problems:
        raise RuntimeError(f"the recorded file is damaged: {problems[0]}")
    return state, index.result.resets


def _portable(error: UserError | OSError, folder: Path) -> UserError | OSError:
    """Return the same error in a form that can be pickled. An OSError without a path gets the path
    `folder`."""
    if isinstance(error, OSError):
        where = error.filename or str(folder)
        return OSError(error.errno or 0, error.strerror or str(error), where)
    return UserError(str(error))


def worker_main(connection: Connection, parent: int) -> None:
    """Main function of a recording process: records each `Job` received over `connection`.

    `parent` is the process id of the collector. One process records many rounds, because compiled
    code and the graphics context take seconds to set up.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent handles Ctrl-C
    exit_with_parent(parent)
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)  # stdout is for the result only
    warm_up()
    while True:
        try:
            job: Job | None = connection.recv()
        except EOFError:
            return  # the parent has ended
        if job is None:
            return
        try:
            connection.send(attempt(job, connection.send))
        except BrokenPipeError:
            return


def exit_with_parent(parent: int) -> None:
    """Make this process end when its collector (process id `parent`) ends: another collector may
    then record the same round."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0)
    if os.getppid() != parent:
        sys.exit(1)


def warm_up() -> None:
    """Import the modules that take long to load."""
    import_module("simulator.world.world")
