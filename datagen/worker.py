"""A recording process: takes rounds from its parent, one after the other, until told to stop.

It lives across rounds because compiled code and the graphics context cost seconds to set up.
"""

import os
import signal
import traceback
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from importlib import import_module
from multiprocessing.connection import Connection
from pathlib import Path

from datagen.errors import RoundFailed
from datagen.plan import RoundPlan
from datagen.recording.check import check_round
from datagen.recording.folder import (
    RoundState,
    discard_partial,
    file_sha256,
    partial_path,
    publish,
)
from datagen.recording.index import open_round
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
class Hopeless:
    """The user's or the machine's mistake, which every round would meet: `error` is raised."""

    error: UserError | OSError


Message = FramesDone | RoundDone | RoundBroken | Hopeless


def work(connection: Connection) -> None:
    """Main function of the process."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches the parent, which decides
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)  # stdout belongs to the result
    with _silence():
        import_module("simulator.physics")
    while True:
        try:
            job: Job | None = connection.recv()
        except EOFError:
            return  # the parent is gone
        if job is None:
            return
        try:
            message: Message = _attempt(job, connection)
        except BrokenPipeError:
            return
        connection.send(message)


def record_and_publish(job: Job, report: Connection | None = None) -> RoundDone:
    """Record one round into its dataset folder: afterwards it is there, checked, or not at all."""
    # Only here: the parent loads this module too, and needs neither physics nor graphics.
    from datagen.record import record_round

    def progress(frames: int) -> None:
        if report is not None and frames % REPORT_EVERY == 0:
            report.send(FramesDone(job.plan.id, frames))

    partial = partial_path(job.folder, job.plan.id)
    try:
        record_round(job.plan, job.plan_hash, partial, job.tracks_dir, progress)
        result = open_round(partial).result
        state = RoundState(
            id=job.plan.id,
            file=f"rounds/{job.plan.id}.mcap",
            bytes=partial.stat().st_size,
            sha256=file_sha256(partial),
            frames=result.frames,
            content_hash=result.content_hash,
            definitions=_definitions(partial),
        )
        _, problems = check_round(partial, "full", state)
        if problems:
            raise RuntimeError(f"read back, it is not what was written: {problems[0]}")
        publish(job.folder, partial, state)
    finally:
        discard_partial(job.folder, job.plan.id)
    return RoundDone(state, result.resets)


def _definitions(path: Path) -> str:
    return open_round(path).header.definitions


def _attempt(job: Job, connection: Connection) -> Message:
    try:
        return record_and_publish(job, connection)
    except BrokenPipeError:
        raise
    except RoundFailed as error:
        return RoundBroken(job.plan.id, str(error), final=True)
    except (UserError, OSError) as error:
        return Hopeless(_portable(error))
    except Exception as error:  # noqa: BLE001  # whatever it is costs this round, not the others
        traceback.print_exc()
        return RoundBroken(job.plan.id, f"{type(error).__name__}: {error}")


@contextmanager
def _silence() -> Iterator[None]:
    """PyBullet greets on stderr when it is loaded: the user has no use for that."""
    kept = os.dup(2)
    os.dup2(1, 2)
    try:
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)


def _portable(error: UserError | OSError) -> UserError | OSError:
    """The same error, sure to survive the way to another process."""
    if isinstance(error, OSError):
        return OSError(error.errno or 0, error.strerror or str(error), error.filename)
    return UserError(str(error))
