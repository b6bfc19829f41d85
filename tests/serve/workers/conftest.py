"""Fake workers, which load no model, for tests of the supervisor."""

import asyncio
import json
import socket
from pathlib import Path
from typing import Any

import pytest

from runtime.sockets import bind
from serve.config import Limits
from serve.workers import supervisor as module
from serve.workers.supervisor import ServicePlan, Supervisor
from serve.workers.worker_process import WorkerProcess, WorkerTask
from tests.serve.conftest import PATIENCE_S


class FakeProcess:
    """A fake worker process, which runs until it is terminated."""

    def __init__(self) -> None:
        self.pid = 1
        self.returncode: int | None = None
        self._ended = asyncio.Event()

    async def wait(self) -> int:
        await self._ended.wait()
        return 0

    def terminate(self) -> None:
        self.returncode = 0
        self._ended.set()


class FakeWorkers:
    """Starts fake workers. They become ready if `is_ready`; loading `failing_folders` fails. A
    worker that expects other weights than `model_hash` ends at its start."""

    def __init__(self) -> None:
        self.started: list[WorkerProcess] = []
        self.failing_folders: set[str] = set()
        self.model_hash = "a" * 64
        self.cameras: list[Any] = []
        """The cameras in the messages for a reload."""
        self.is_ready = True
        self.is_loading = False
        """Whether the workers never finish loading."""
        self._tasks: set[asyncio.Task[None]] = set()

    async def start(self, task: WorkerTask) -> WorkerProcess:
        ours, theirs = socket.socketpair()
        reader, writer = await asyncio.open_connection(sock=ours)
        process: Any = FakeProcess()
        worker = WorkerProcess(task, process, reader, writer)
        self.started.append(worker)
        expected = task.expected in (None, self.model_hash)
        run = asyncio.ensure_future(
            self._run(task, theirs) if expected else self._fail(task, theirs, process)
        )
        self._tasks.add(run)
        if expected and not self.is_loading:
            await worker.wait_loaded(task.generation, PATIENCE_S)
        return worker

    async def _fail(
        self, task: WorkerTask, connection: socket.socket, process: FakeProcess
    ) -> None:
        _, writer = await asyncio.open_connection(sock=connection)
        await asyncio.sleep(0.1)  # the time in which it loads the model
        message = {"failed": task.generation, "why": "other weights"}
        writer.write(json.dumps(message).encode() + b"\n")
        writer.close()
        process.terminate()

    async def _run(self, task: WorkerTask, connection: socket.socket) -> None:
        reader, writer = await asyncio.open_connection(sock=connection)

        def send(**message: object) -> None:
            writer.write(json.dumps(message).encode() + b"\n")

        if self.is_loading:
            await reader.read()  # until the supervisor closes the socket
            return
        send(loaded=task.generation, model=self.model_hash, engine="fake", precision="f32")
        if self.is_ready:
            send(ready=True)
        async for line in reader:
            message = json.loads(line)
            if "load" not in message:
                continue
            self.cameras.append(message["cameras"])
            if message["load"] in self.failing_folders:
                send(failed=message["generation"], why="the weights are damaged")
            else:
                self.model_hash = "b" * 64
                send(
                    loaded=message["generation"],
                    model=self.model_hash,
                    engine="fake",
                    precision="f32",
                )


@pytest.fixture
def workers(monkeypatch: pytest.MonkeyPatch) -> FakeWorkers:
    found = FakeWorkers()
    monkeypatch.setattr(module, "start_worker", found.start)
    return found


def make_supervisor(folder: Path) -> Supervisor:
    plan = ServicePlan("run", lambda name: folder / name, 2, Limits())
    return Supervisor(plan, [bind("127.0.0.1", 0)])


async def until_started(workers: FakeWorkers, count: int) -> None:
    async with asyncio.timeout(PATIENCE_S):
        while len(workers.started) < count:
            await asyncio.sleep(0.01)
