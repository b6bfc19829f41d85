"""Shared by the tests of collection: runs the command and makes jobs."""

import math
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from unittest.mock import patch

from datagen.execution.process_pool import ProcessPool
from datagen.execution.retry import Failure, RetryQueue, Timeouts
from datagen.planning.config import CollectConfig
from datagen.planning.plan import Plan
from datagen.planning.planner import make_plan
from datagen.planning.tracks import choose_tracks
from datagen.recorder.job import Job, Outcome, attempt
from datagen.recording.folder import prepare
from datagen.recording.integrity.recover import recover
from tests.typed import typed

ROUNDS = ["--rounds", "3", "--frames", "20", "--tracks", "oval", "--workers", "1"]
SHORT = ["--rounds", "2", "--frames", "30", "--tracks", "circuit", "--lanes", "1,2"]


def datagen(
    *args: object,
    preexec_fn: Callable[[], object] | None = None,
    env: dict[str, str] | None = None,
) -> subprocess.CompletedProcess[str]:
    """The command in a process of its own."""
    command = [sys.executable, "-m", "datagen", *map(str, args)]
    return subprocess.run(
        command, capture_output=True, text=True, timeout=600, preexec_fn=preexec_fn, env=env
    )


def datagen_here(*args: object) -> subprocess.CompletedProcess[str]:
    """Run the command in this process; for commands that start no other processes."""
    return typed("datagen", *args)


@contextmanager
def recording_here() -> Iterator[None]:
    """Rounds are recorded in this process; a recording process takes 5 s to start. For tests that
    are not about these processes."""

    def run(pool: ProcessPool, jobs: Iterable[Job]) -> list[Failure]:
        queue = RetryQueue(jobs, Timeouts(), pool._on_message)
        while job := queue.take(math.inf):
            queue.record_outcome(job, attempt(job, pool._on_message))
        return queue.failures

    with patch.object(ProcessPool, "run", run):
        yield


def make_small_plan(rounds: int, frames: int) -> Plan:
    tracks = choose_tracks(("oval",), None)
    return make_plan(CollectConfig(rounds, frames, seed=1, tracks=tracks, stretch=0))


def make_jobs(folder: Path, rounds: int, frames: int) -> list[Job]:
    plan = make_small_plan(rounds, frames)
    prepare(folder)
    return [Job(entry, plan.hash, folder, None) for entry in plan.rounds]


def attempted(job: Job) -> Outcome:
    return attempt(job, lambda message: None)


def with_recovered(whole: Path, folder: Path, kept: float = 0.75) -> tuple[Path, int]:
    """A copy of the dataset in which round-001 was cut to the share `kept` of its bytes and
    recovered; and its number of frames."""
    shutil.copytree(whole, folder)
    file = folder / "rounds" / "round-001.mcap"
    damaged = folder.parent / "cut.mcap"
    damaged.write_bytes(file.read_bytes()[: int(file.stat().st_size * kept)])
    file.unlink()
    saved = recover(damaged, file).saved
    assert 0 < saved < 20
    return folder, saved
