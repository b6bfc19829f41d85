"""Interruptions, crashes, hanging processes, rounds that cannot be driven."""

import json
import multiprocessing
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from multiprocessing.process import BaseProcess
from pathlib import Path

import pytest

from datagen.errors import RoundFailed
from datagen.execution import process_pool
from datagen.execution.collect import collect
from datagen.execution.process_pool import ProcessPool
from datagen.execution.retry import ATTEMPTS, DEATHS_IN_A_ROW, RetryQueue, Timeouts
from datagen.planning.plan import RoundPlan
from datagen.recorder.job import AttemptFailed, FatalError, FramesDone, RoundDone
from datagen.recording.errors import DatasetError
from datagen.recording.folder import RoundState, read_states
from datagen.recording.integrity.verify import verify
from simulator.vehicle.state import Command
from simulator.world.errors import ContactsUnavailable
from tests.datagen.commands import (
    attempted,
    datagen_here,
    make_jobs,
    make_small_plan,
    recording_here,
)
from tests.datagen.conftest import Samples
from trackfeatures.camera import CameraParameters


@pytest.mark.parametrize(
    "number", [signal.SIGINT, pytest.param(signal.SIGTERM, marks=pytest.mark.extended)]
)
def test_an_interruption_leaves_whole_rounds_only_and_is_resumed(
    tmp_path: Path, number: signal.Signals
) -> None:
    folder = tmp_path / "data"
    args = ["collect", "--rounds", "3", "--frames", "60", "--tracks", "oval", "--workers", "1"]
    command = [sys.executable, "-m", "datagen", *args, "--out", str(folder)]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as process:
        wait_for(lambda: list(folder.glob("state/*.json")), process)
        wait_for(lambda: list(folder.glob(".partial/*/*.mcap")), process)
        process.send_signal(number)
        _, stderr = process.communicate(timeout=120)
    assert process.returncode == 130
    assert "Traceback" not in stderr
    kept = read_states(folder)
    assert 1 <= len(kept) < 3
    assert not (folder / ".partial").exists()
    assert len(list(folder.glob("rounds/*"))) == len(kept)
    assert verify(folder, "full").ok
    if number == signal.SIGINT:
        with recording_here():
            done = datagen_here(*args, "--out", folder, "--json")
        assert json.loads(done.stdout)["recorded_frames"] == 60 * (3 - len(kept))
        assert verify(folder, "full").ok


def test_the_round_of_a_dead_worker_is_retried_and_the_others_are_kept(
    tmp_path: Path,
) -> None:
    jobs = make_jobs(tmp_path, rounds=2, frames=30)
    killed: list[str] = []
    done: list[str] = []

    def on_message(message: FramesDone | RoundDone) -> None:
        if isinstance(message, RoundDone):
            done.append(message.state.id)
        elif not killed:
            killed.append(message.round_id)
            pool._workers[0].process.kill()

    pool = ProcessPool(1, on_message)
    assert pool.run(jobs) == []
    assert killed == ["round-000"]
    assert sorted(done) == ["round-000", "round-001"] == sorted(read_states(tmp_path))


def test_a_round_that_cannot_be_driven_is_tried_once_and_reported_in_one_line(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
    samples: Samples,
) -> None:
    """Workers are forked, so they inherit the patched recording function."""

    def record(plan: RoundPlan, plan_hash: str, path: Path, *rest: object) -> None:
        with (tmp_path / "attempts").open("a") as stream:
            stream.write(f"{plan.id}\n")
        if plan.id == "round-000":
            raise RoundFailed("the car left the road 21 times")
        header = replace(samples.header("r001"), id=plan.id, seed=plan.seed)
        samples.write(path, header, samples.frames(3, seed=1))

    monkeypatch.setattr("datagen.recorder.record.record_round", record)
    monkeypatch.setattr(
        "datagen.execution.process_pool.CONTEXT", multiprocessing.get_context("fork")
    )
    plan = make_small_plan(2, 3)
    capfd.readouterr()  # drops the output of libraries at import
    expected = r"1 of 2 rounds failed \(round-000: the car left the road 21 times\); the finished"
    with pytest.raises(DatasetError, match=expected) as told:
        collect(plan, tmp_path / "data", workers=1)
    assert "another --seed" in str(told.value)
    assert (tmp_path / "attempts").read_text().split() == ["round-000", "round-001"]
    assert capfd.readouterr().err == ""
    assert list(read_states(tmp_path / "data")) == ["round-001"]
    assert verify(tmp_path / "data", "full").ok


def test_a_contact_without_pybullet_ends_only_its_round(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def touch(*args: object) -> None:
        raise ContactsUnavailable("contacts need PyBullet")

    (job,) = make_jobs(tmp_path, rounds=1, frames=10)
    job = replace(job, plan=replace(job.plan, camera=CameraParameters(width=56, height=42)))
    monkeypatch.setattr("simulator.world.world.World.step", touch)
    assert attempted(job) == AttemptFailed(job.plan.id, "contacts need PyBullet", final=True)


@pytest.mark.contacts
def test_a_car_that_is_reset_too_often_ends_its_round(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("datagen.recorder.record.MAX_RESETS", 0)
    monkeypatch.setattr(
        "datagen.recorder.record.ScriptedDriver.command", lambda *args: Command(1.0, 1.0)
    )
    (job,) = make_jobs(tmp_path, rounds=1, frames=200)
    job = replace(job, plan=replace(job.plan, camera=CameraParameters(width=56, height=42)))
    message = attempted(job)
    assert isinstance(message, AttemptFailed)
    assert message.final
    assert "left the road 1 times on oval, " in message.reason
    assert not list(tmp_path.glob("rounds/*"))


def wait_for(found: Callable[[], object], process: subprocess.Popen[str]) -> None:
    stderr = process.stderr
    assert stderr is not None
    deadline = time.monotonic() + 300.0
    while not found():
        assert process.poll() is None, stderr.read()
        assert time.monotonic() < deadline
        time.sleep(0.02)


@pytest.mark.extended
def test_a_process_without_heartbeat_is_replaced(tmp_path: Path) -> None:
    """A process stopped by SIGSTOP is alive but sends no messages."""
    stopped: list[int] = []
    done: list[str] = []

    def on_message(message: FramesDone | RoundDone) -> None:
        if isinstance(message, RoundDone):
            done.append(message.state.id)
        elif message.frames:
            worker = pool._workers[0]
            if not stopped:
                stopped.append(worker.process.pid or 0)
                os.kill(stopped[0], signal.SIGSTOP)
            if worker.process.pid == stopped[0]:
                worker.last_heartbeat -= (
                    timeouts.heartbeat_s - 1.0
                )  # one second is left of its time

    timeouts = Timeouts(retry_delay_s=0.1)
    pool = ProcessPool(1, on_message, timeouts)
    assert pool.run(make_jobs(tmp_path, rounds=1, frames=400)) == []
    assert done == ["round-000"]
    with pytest.raises(ProcessLookupError):
        os.kill(stopped[0], 0)


def test_a_round_that_takes_too_long_is_tried_three_times_and_given_up(tmp_path: Path) -> None:
    started: list[float] = []

    def on_message(message: FramesDone | RoundDone) -> None:
        if isinstance(message, FramesDone) and message.frames == 0:
            started.append(time.monotonic())

    pool = ProcessPool(1, on_message, Timeouts(round_start_s=1.0, frame_s=0.0, retry_delay_s=0.2))
    (failure,) = pool.run(make_jobs(tmp_path, rounds=1, frames=100_000))
    assert failure.round_id == "round-000"
    assert "did not finish the round in 1 s" in failure.reason
    assert not failure.final
    assert len(started) == ATTEMPTS


def test_the_share_of_the_cores_is_that_of_the_started_processes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    limited: list[int] = []

    def limits(workers: int) -> dict[str, str]:
        limited.append(workers)
        raise OSError(f"{workers} processes")

    monkeypatch.setattr(process_pool, "thread_limits", limits)
    for rounds in (1, 3):
        with pytest.raises(OSError, match="processes"):
            ProcessPool(2, lambda message: None).run(make_jobs(tmp_path, rounds, frames=10))
    assert limited == [1, 2]
    assert ProcessPool(2, lambda message: None).run([]) == []


def test_an_interrupt_at_the_start_of_a_process_is_not_lost(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    start, started = BaseProcess.start, []

    def interrupted_start(process: BaseProcess) -> None:
        os.kill(os.getpid(), signal.SIGINT)
        start(process)
        started.append(process)

    monkeypatch.setattr(BaseProcess, "start", interrupted_start)
    pool = ProcessPool(2, lambda message: None)
    with pytest.raises(KeyboardInterrupt):
        pool.run(make_jobs(tmp_path, rounds=2, frames=10))
    assert [process.exitcode is not None for process in started] == [True]
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    assert not signal.pthread_sigmask(signal.SIG_BLOCK, ())


def test_retries_have_growing_delays_and_end_after_the_third_attempt(tmp_path: Path) -> None:
    (job, other) = make_jobs(tmp_path, rounds=2, frames=10)
    messages: list[FramesDone | RoundDone] = []
    queue = RetryQueue([job, other], Timeouts(retry_delay_s=2.0), messages.append)
    assert queue.take(0.0) == job
    queue.record_failure(job, "first", now=10.0)
    assert (queue.next_at(), queue.take(10.0)) == (0.0, other)
    assert (queue.next_at(), queue.take(11.9)) == (12.0, None)
    assert queue.take(12.0) == job
    queue.record_failure(job, "second", now=20.0)
    assert (queue.take(27.9), queue.take(28.0)) == (None, job)
    queue.record_failure(job, "third", now=30.0)
    assert (len(queue), queue.take(1e9)) == (0, None)
    assert [(f.round_id, f.reason, f.final) for f in queue.failures] == [
        ("round-000", "third", False)
    ]
    queue.record_failure(other, "for good", now=30.0, final=True)
    assert queue.failures[1].final
    assert messages == [FramesDone(f"round-00{number}", 0) for number in (0, 0, 0, 1)]


def test_repeated_process_deaths_end_the_collection(tmp_path: Path) -> None:
    done = RoundDone(RoundState("round-000", "rounds/round-000.mcap", 1, "", 10, "", ""), resets=0)
    (job,) = make_jobs(tmp_path, rounds=1, frames=10)
    messages: list[FramesDone | RoundDone] = []
    queue = RetryQueue((), Timeouts(), messages.append)
    for _ in range(DEATHS_IN_A_ROW - 1):
        queue.record_death(None, "code -11")
    queue.record_outcome(job, done)
    assert messages == [done]
    for _ in range(DEATHS_IN_A_ROW - 1):
        queue.record_death(None, "code -11")
    assert len(queue) == 0
    with pytest.raises(DatasetError, match=r"ended one after the other .*code -11"):
        queue.record_death(job, "code -11")


def test_the_round_of_a_dead_process_is_queued_again(tmp_path: Path) -> None:
    (job,) = make_jobs(tmp_path, rounds=1, frames=10)
    queue = RetryQueue((), Timeouts(retry_delay_s=0.0), lambda message: None)
    queue.record_death(job, "code -11")
    assert (len(queue), queue.failures) == (1, [])
    for outcome in (AttemptFailed("round-000", "again"), AttemptFailed("round-000", "the third")):
        queue.record_outcome(job, outcome)
    assert [(f.reason, f.final) for f in queue.failures] == [("the third", False)]
    with pytest.raises(OSError, match="No space left"):
        queue.record_outcome(job, FatalError(OSError(28, "No space left on device")))


def test_no_worker_outlives_a_collector_that_was_killed(tmp_path: Path) -> None:
    args = ["collect", "--rounds", "2", "--frames", "5000", "--tracks", "oval", "--workers", "1"]
    command = [sys.executable, "-m", "datagen", *args, "--out", str(tmp_path / "data")]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as process:
        wait_for(lambda: list(tmp_path.glob("data/.partial/*/*.mcap")), process)
        children = _children(process.pid)
        process.kill()
        process.communicate(timeout=120)
    assert children
    deadline = time.monotonic() + 120.0
    while any(Path(f"/proc/{child}/cmdline").exists() for child in children):
        assert time.monotonic() < deadline
        time.sleep(0.02)


def _children(process: int) -> list[int]:
    tasks = Path(f"/proc/{process}/task/{process}/children").read_text()
    return [int(child) for child in tasks.split()]


@pytest.mark.extended
def test_kills_of_the_whole_tree_at_random_moments_lose_nothing() -> None:
    """A short run of the benchmark that kills collections."""
    script = Path(__file__).parents[3] / "benchmarks" / "collect_killed.py"
    small = ["--kills", "3", "--rounds", "3", "--frames", "10", "--seed", "2"]
    done = subprocess.run(
        [sys.executable, str(script), *small], capture_output=True, text=True, timeout=500
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert json.loads(done.stdout)["kills"] == 3
