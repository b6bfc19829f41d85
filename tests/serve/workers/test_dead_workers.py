"""The replacement of dead workers, and a reload while workers are dead."""

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path

import pytest

from serve.shared_memory import BODY_BYTES
from serve.workers import supervisor as module
from serve.workers.supervisor import Supervisor
from serve.workers.worker_process import WorkerProcess, WorkerTask
from tests.serve.conftest import PATIENCE_S
from tests.serve.workers.conftest import FakeWorkers, make_supervisor, until_started
from trackfeatures.errors import UserError


@asynccontextmanager
async def running(supervisor: Supervisor) -> AsyncIterator[Supervisor]:
    """Start the workers; within the block, dead workers are replaced. Then stop all workers."""
    await supervisor.start()
    run = asyncio.ensure_future(supervisor.run())
    await asyncio.sleep(0)
    yield supervisor
    supervisor._stopping.set()
    await run


def test_a_killed_worker_leaves_no_bodies_in_the_budget(
    workers: FakeWorkers, tmp_path: Path
) -> None:
    """The replacement of a killed worker can use another block of the shared memory."""

    async def scenario() -> None:
        async with running(make_supervisor(tmp_path)) as supervisor:
            await supervisor.restart()
            killed = max(workers.started[2:], key=lambda worker: worker.task.block)
            cells = supervisor._shared.worker(killed.task.block)
            cells[BODY_BYTES] = 60e6
            killed._process.terminate()
            await until_started(workers, 5)
            assert workers.started[-1].task.block != killed.task.block
            assert cells[BODY_BYTES] == 0.0

    asyncio.run(scenario())


def test_a_worker_that_cannot_be_started_is_tried_again(
    workers: FakeWorkers, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "MIN_BACKOFF_S", 0.01)
    failures: list[OSError] = []

    async def fail_twice(task: WorkerTask) -> WorkerProcess:
        if len(failures) < 2:
            failures.append(BlockingIOError("Resource temporarily unavailable"))
            raise failures[-1]
        return await workers.start(task)

    async def scenario() -> None:
        async with running(make_supervisor(tmp_path)):
            monkeypatch.setattr(module, "start_worker", fail_twice)
            dead = workers.started[0]
            dead._process.terminate()
            await until_started(workers, 3)
        assert dead._writer.is_closing()

    asyncio.run(scenario())
    assert len(failures) == 2


@pytest.mark.parametrize("dead", [1, 2])
def test_a_reload_after_a_training_succeeds_although_workers_are_dead(
    workers: FakeWorkers, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, dead: int
) -> None:
    """Their replacements expect the old weights, which the training has replaced."""
    monkeypatch.setattr(module, "MIN_BACKOFF_S", 0.01)

    async def scenario() -> None:
        async with running(make_supervisor(tmp_path)) as supervisor:
            workers.model_hash = "b" * 64
            for worker in workers.started[:dead]:
                worker._process.terminate()
            await until_started(workers, 2 + dead)  # the replacements are loading the model
            assert await supervisor.reload("new") == "b" * 64
            assert supervisor.folder == tmp_path / "new"
            async with asyncio.timeout(PATIENCE_S):
                while not all(worker.alive for worker in supervisor._workers.values()):
                    await asyncio.sleep(0.01)
            last = workers.started[-1].task
            assert (last.folder, last.expected) == (str((tmp_path / "new").resolve()), "b" * 64)

    asyncio.run(scenario())


def test_a_reload_without_workers_fails_if_the_model_does(
    workers: FakeWorkers, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "LOAD_TIMEOUT_S", 0.1)

    async def scenario() -> None:
        supervisor = make_supervisor(tmp_path)
        await supervisor.start()
        for worker in workers.started:
            worker._process.terminate()
        workers.is_ready = False
        with pytest.raises(UserError, match=r"was not ready within 0\.1 s"):
            await supervisor.reload("new")
        assert supervisor.folder == tmp_path / "run"
        assert not any(worker.alive for worker in workers.started)

    asyncio.run(scenario())
