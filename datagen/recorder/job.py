"""One round from its plan to its place in a dataset folder: there whole and checked, or not at all.

The same for a process of this machine and for one of a Ray cluster.
"""

import ctypes
import os
import signal
import sys
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from importlib import import_module
from multiprocessing.connection import Connection
from pathlib import Path

from datagen.errors import RoundFailed
from datagen.planning.plan import RoundPlan
from datagen.recording.folder import (
    RoundState,
    discard_partial,
    file_sha256,
    partial_path,
    publish,
)
from datagen.recording.integrity.round_checks import check_round
from datagen.recording.mcap.index import open_round
from trackfeatures.errors import UserError

REPORT_EVERY = 10  # frames


@dataclass(frozen=True, slots=True)
class Job:
    plan: RoundPlan
    plan_hash: str
    folder: Path
    tracks_dir: Path | None


@dataclass(frozen=True, slots=True)
class FramesDone:
    """So far; sent at least at every step of the work, as a sign of life."""

    round_id: str
    frames: int


@dataclass(frozen=True, slots=True)
class RoundDone:
    state: RoundState
    resets: int


@dataclass(frozen=True, slots=True)
class RoundBroken:
    """This round failed; the others may do better, and so may another try, unless `final`."""

    round_id: str
    reason: str
    final: bool = False


@dataclass(frozen=True, slots=True)
class FatalError:
    """The user's or the machine's mistake, which every round would meet: `error` is raised."""

    error: UserError | OSError


Ending = RoundDone | RoundBroken | FatalError
Message = FramesDone | Ending
Report = Callable[[FramesDone], None]


def attempt(job: Job, report: Report) -> Ending:
    """Try to record a round; what went wrong is in the answer. BrokenPipeError is for `report`."""
    try:
        return record_and_publish(job, report)
    except BrokenPipeError:
        raise
    except RoundFailed as error:
        return RoundBroken(job.plan.id, str(error), final=True)
    except (UserError, OSError) as error:
        return FatalError(_portable(error, job.folder))
    except Exception as error:  # noqa: BLE001  # whatever it is costs this round, not the others
        traceback.print_exc()
        return RoundBroken(job.plan.id, f"{type(error).__name__}: {error}")


def record_and_publish(job: Job, report: Report = lambda message: None) -> RoundDone:
    """Record one round into its dataset folder: afterwards it is there, checked, or not at all."""
    # Only here: the parent loads this module too, and needs neither physics nor graphics.
    from datagen.recorder.record import record_round

    def progress(frames: int) -> None:
        if frames % REPORT_EVERY == 0:
            report(FramesDone(job.plan.id, frames))

    partial = partial_path(job.folder, job.plan.id)
    try:
        record_round(job.plan, job.plan_hash, partial, job.tracks_dir, progress)
        report(FramesDone(job.plan.id, job.plan.frames))
        state, resets = _checked(job.plan.id, partial)
        publish(job.folder, partial, state)
    finally:
        discard_partial(job.folder, job.plan.id)
    return RoundDone(state, resets)


def _checked(round_id: str, partial: Path) -> tuple[RoundState, int]:
    """The state of a file that is what was written, and how often its car was put back."""
    index = open_round(partial)
    state = RoundState(
        id=round_id,
        file=f"rounds/{round_id}.mcap",
        bytes=partial.stat().st_size,
        sha256=file_sha256(partial),
        frames=index.result.frames,
        content_hash=index.result.content_hash,
        definitions=index.header.definitions,
    )
    _, problems = check_round(partial, "full", state)
    if problems:
        raise RuntimeError(f"read back, it is not what was written: {problems[0]}")
    return state, index.result.resets


def _portable(error: UserError | OSError, folder: Path) -> UserError | OSError:
    """The same error, sure to survive the way to another process, and to say where it was."""
    if isinstance(error, OSError):
        where = error.filename or str(folder)
        return OSError(error.errno or 0, error.strerror or str(error), where)
    return UserError(str(error))


# A recording process: takes rounds from its parent, one after the other, until told to stop. It
# lives across rounds because compiled code and the graphics context cost seconds to set up.


PR_SET_PDEATHSIG = 1  # <linux/prctl.h>


def work(connection: Connection, parent: int) -> None:
    """Main function of the process; `parent` is the process that it works for."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches the parent, which decides
    die_with(parent)
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)  # stdout belongs to the result
    warm_up()
    while True:
        try:
            job: Job | None = connection.recv()
        except EOFError:
            return  # the parent is gone
        if job is None:
            return
        try:
            connection.send(attempt(job, connection.send))
        except BrokenPipeError:
            return


def die_with(parent: int) -> None:
    """No round goes on when its collector was killed: the next one may be recording it already."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0)
    if os.getppid() != parent:
        sys.exit(1)


def warm_up() -> None:
    """Load what takes long to load."""
    with _silence():
        import_module("simulator.world.physics")


@contextmanager
def _silence() -> Iterator[None]:
    """PyBullet greets on stderr when it is loaded: the user has no use for that."""
    kept = os.dup(2)
    nothing = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nothing, 2)
    try:
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        os.close(nothing)
