"""Reload and restart with failing workers; the workers are fakes that load no model."""

import asyncio
import signal
from pathlib import Path

import pytest

from runtime.sockets import bind
from serve.config import Limits
from serve.workers import supervisor as module
from serve.workers.supervisor import ServicePlan, Supervisor
from tests.serve.conftest import PATIENCE_S
from tests.serve.workers.conftest import FakeWorkers, make_supervisor, until_started
from trackfeatures.camera import CameraParameters
from trackfeatures.errors import UserError


def test_a_stop_is_obeyed_while_the_model_is_loaded_and_a_reload_is_not_needed(
    workers: FakeWorkers, tmp_path: Path
) -> None:
    workers.is_loading = True

    async def start_and_stop() -> object:
        supervisor = make_supervisor(tmp_path)
        starting = asyncio.ensure_future(supervisor.start())
        while len(workers.started) < 2:
            await asyncio.sleep(0.01)
        for number in (signal.SIGHUP, signal.SIGUSR2, signal.SIGTERM):
            assert not starting.done()
            signal.raise_signal(number)
            await asyncio.sleep(0.05)
        return await asyncio.wait_for(starting, PATIENCE_S)

    assert asyncio.run(start_and_stop()) is None
    assert not any(worker.alive for worker in workers.started)


@pytest.mark.parametrize(
    ("at_start", "before", "now", "stops"),
    [
        (signal.SIG_DFL, True, False, True),
        (signal.SIG_DFL, True, True, False),
        (signal.SIG_DFL, False, False, False),
        (signal.SIG_IGN, True, False, False),
    ],
)
def test_a_hangup_stops_a_service_whose_terminal_was_closed_but_not_under_nohup(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    at_start: signal.Handlers,
    before: bool,
    now: bool,
    stops: bool,
) -> None:
    """`at_start`: the action of SIGHUP when the service starts."""
    reloads: list[bool] = []
    monkeypatch.setattr(module, "_has_terminal", lambda: before)
    action = signal.signal(signal.SIGHUP, at_start)
    try:
        supervisor = make_supervisor(tmp_path)
    finally:
        signal.signal(signal.SIGHUP, action)
    monkeypatch.setattr(module, "_has_terminal", lambda: now)
    supervisor._on_hangup(lambda: reloads.append(True))
    assert (supervisor._stopping.is_set(), bool(reloads)) == (stops, not stops)


def test_a_reload_after_a_failed_reload_loads_the_model(
    workers: FakeWorkers, tmp_path: Path
) -> None:
    workers.failing_folders.add(str((tmp_path / "broken").resolve()))

    async def scenario() -> None:
        supervisor = make_supervisor(tmp_path)
        await supervisor.start()
        for _ in range(2):
            with pytest.raises(UserError, match="damaged; the old model stays in use"):
                await supervisor.reload("broken")
        assert await supervisor.reload("good") == "b" * 64
        assert supervisor.folder == tmp_path / "good"

    asyncio.run(scenario())


def test_a_reload_reads_the_cameras_again_for_the_new_model(
    workers: FakeWorkers, tmp_path: Path
) -> None:
    heights = {"run": 0.95, "high": 1.55}

    def cameras(folder: Path) -> dict[str, CameraParameters]:
        if folder.name not in heights:
            raise UserError("roof.yaml: with this camera the image shows too little")
        return {"roof": CameraParameters(z=heights[folder.name])}

    async def scenario() -> None:
        plan = ServicePlan("run", lambda name: tmp_path / name, 2, Limits(), cameras)
        supervisor = Supervisor(plan, [bind("127.0.0.1", 0)])
        await supervisor.start()
        with pytest.raises(UserError, match="shows too little; the old model stays in use"):
            await supervisor.reload("narrow")
        await supervisor.restart()
        await supervisor.reload("high")
        await supervisor.restart()

    asyncio.run(scenario())
    sent = [worker.task.cameras["roof"].z for worker in workers.started]
    assert sent == [0.95] * 4 + [1.55] * 2
    assert workers.cameras == [{"roof": CameraParameters(z=1.55).as_dict()}] * 2


def test_a_replacement_that_does_not_become_ready_is_stopped(
    workers: FakeWorkers, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    async def scenario() -> None:
        supervisor = make_supervisor(tmp_path)
        await supervisor.start()
        monkeypatch.setattr(module, "LOAD_TIMEOUT_S", 0.05)
        workers.is_ready = False
        with pytest.raises(UserError, match="not ready"):
            await supervisor.restart()
        monkeypatch.setattr(module, "LOAD_TIMEOUT_S", PATIENCE_S)
        workers.is_ready = True
        await supervisor.restart()

    asyncio.run(scenario())
    first, second, timed_out, *replacements = workers.started
    assert not timed_out.alive
    assert not first.alive  # the second restart has replaced it
    assert not second.alive
    assert all(worker.alive for worker in replacements)
    blocks = [worker.task.block for worker in replacements]
    assert len(set(blocks)) == len(blocks) == 2  # no two workers write to the same block


def test_a_worker_that_failed_a_reload_and_died_later_reports_how_it_died(
    workers: FakeWorkers, tmp_path: Path
) -> None:
    workers.failing_folders.add(str((tmp_path / "broken").resolve()))

    async def scenario() -> str:
        supervisor = make_supervisor(tmp_path)
        await supervisor.start()
        with pytest.raises(UserError):
            await supervisor.reload("broken")
        await workers.started[0].stop(1.0)
        return workers.started[0].exit_reason()

    assert asyncio.run(scenario()) == "exit code 0"


def test_a_replacement_that_ends_is_reported_with_its_end(
    workers: FakeWorkers, tmp_path: Path
) -> None:
    async def scenario() -> None:
        supervisor = make_supervisor(tmp_path)
        await supervisor.start()
        workers.is_ready = False
        restart = asyncio.ensure_future(supervisor.restart())
        await until_started(workers, 3)
        workers.started[-1]._process.terminate()
        with pytest.raises(UserError, match=r"ended before it was ready \(exit code 0\)"):
            await restart

    asyncio.run(scenario())
