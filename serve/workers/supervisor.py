"""The parent process of the workers: it starts them, replaces dead workers, distributes weights.

It answers no requests and loads no engine. SIGTERM and SIGINT stop the service, SIGHUP reloads the
model, SIGUSR2 replaces the workers one by one. `serve reload` and `serve restart` request a reload
or a replacement over a Unix socket and print the result.
"""

import asyncio
import logging
import os
import signal
import socket
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from serve.config import Limits
from serve.shared_memory import (
    COMMITTED_GENERATION,
    SharedMemory,
    WorkerPeers,
    create_shared_memory,
)
from serve.workers.last_answers import LastAnswers
from serve.workers.worker_process import WorkerProcess, WorkerTask, start_worker
from trackfeatures.camera import CameraParameters
from trackfeatures.errors import UserError

BACKLOG = 2048
LOAD_TIMEOUT_S = 120.0  # time for a worker to load a model; enough on a busy machine
STOP_TIMEOUT_S = 15.0  # time for a worker to stop after SIGTERM; then it is killed
MIN_BACKOFF_S, MAX_BACKOFF_S = 0.5, 30.0  # pause before a dead worker is replaced
STABLE_AGE_S = 10.0  # a worker that ran for longer did not fail at its start

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class ServicePlan:
    """The model, the number of workers and the limits of a service.

    `resolve` maps a model's name to its folder. `cameras` returns the cameras that clients can
    name, by name, for the model in a folder; it raises UserError if a camera does not fit the
    model. `views`: number of views of each image whose answers are averaged. `threads`: number of
    threads with which each worker computes an answer.
    """

    model: str
    resolve: Callable[[str], Path]
    workers: int
    limits: Limits
    cameras: Callable[[Path], Mapping[str, CameraParameters]] = lambda _folder: {}
    views: int = 1
    threads: int = 1


class Supervisor:
    """Starts, replaces, reloads and stops the workers of one service."""

    def __init__(self, plan: ServicePlan, listeners: Sequence[socket.socket]) -> None:
        self._plan = plan
        self._listeners = listeners
        # One block more than workers: a replacement starts before the old worker stops.
        self._shared: SharedMemory = create_shared_memory(plan.workers + 1)
        self._head = self._shared.head()
        self._workers: dict[int, WorkerProcess] = {}  # by position, 0 to plan.workers - 1
        self._folder = plan.resolve(plan.model)
        self._cameras = plan.cameras(self._folder)
        self._model = plan.model
        self._model_hash: str | None = None
        self._last_generation = 0  # number of the last reload, also if it failed
        self._change_lock = asyncio.Lock()
        self._stopping = asyncio.Event()
        # Under `nohup`, which ignores SIGHUP, the service outlives its terminal.
        nohup = signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
        self._has_terminal = not nohup and _has_terminal()

    @property
    def folder(self) -> Path:
        """The folder of the served model."""
        return self._folder

    async def start(self) -> dict[str, Any] | None:
        """Listen, and start all workers.

        Returns the first worker's report about its engine, or None if the service was stopped while
        the workers loaded the model. Raises UserError if a worker cannot load the model.
        """
        loop = asyncio.get_running_loop()
        for number in (signal.SIGTERM, signal.SIGINT):
            loop.add_signal_handler(number, self._stopping.set)
        # Until all workers have started, there is nothing to reload or to replace.
        loop.add_signal_handler(signal.SIGHUP, self._on_hangup, lambda: None)
        loop.add_signal_handler(signal.SIGUSR2, lambda: None)
        # Listen after the handlers are set: without them, a signal would end the process and reset
        # connections that have not been accepted.
        for listener in self._listeners:
            listener.listen(BACKLOG)
        for position in range(self._plan.workers):
            self._workers[position] = await start_worker(self._task(self._free_block()))
        loading = asyncio.gather(
            *(worker.wait_loaded(0, LOAD_TIMEOUT_S) for worker in self._workers.values())
        )
        stopping = asyncio.ensure_future(self._stopping.wait())
        await asyncio.wait((loading, stopping), return_when=asyncio.FIRST_COMPLETED)
        stopping.cancel()
        if not loading.done():
            loading.cancel()
            # Without this await asyncio would log the exceptions of `loading`.
            await asyncio.gather(loading, return_exceptions=True)
            await self._stop_workers()
            return None
        try:
            reports = await loading
        except UserError:
            await self._stop_workers()
            raise
        self._model_hash = reports[0]["model"]
        return reports[0]

    async def run(self) -> None:
        """Replace dead workers until the service is stopped."""
        loop = asyncio.get_running_loop()
        tasks: set[asyncio.Task[Any]] = set()

        def begin(action: Callable[[], Any]) -> None:
            task = asyncio.ensure_future(_log_errors(action))
            tasks.add(task)
            task.add_done_callback(tasks.discard)

        loop.add_signal_handler(signal.SIGHUP, self._on_hangup, lambda: begin(self.reload))
        loop.add_signal_handler(signal.SIGUSR2, begin, self.restart)
        watchers = [
            asyncio.ensure_future(self._replace_dead(position))
            for position in range(self._plan.workers)
        ]
        await self._stopping.wait()
        for task in (*watchers, *tasks):
            task.cancel()
        await self._stop_workers()

    async def _stop_workers(self) -> None:
        """Stop all workers, then close the listening sockets. Connections that arrive in the
        meantime are answered with 503."""
        last_answers = LastAnswers(self._listeners)
        last_answers.start()
        await asyncio.gather(*(worker.stop(STOP_TIMEOUT_S) for worker in self._workers.values()))
        await last_answers.finish()

    async def reload(self, model: str | None = None) -> str:
        """Load `model` (None: the current model again) in all workers, then switch to it.

        The files of the cameras are read again, because values that a file omits come from the
        model. Returns the hash of the weights. Raises UserError; the old weights and cameras then
        stay in use.
        """
        async with self._change_lock:
            name = model or self._model
            folder = self._plan.resolve(name)
            try:
                cameras = self._plan.cameras(folder)
            except UserError as error:
                raise UserError(f"{error}; the old model stays in use") from error
            workers = await self._loaded_workers()
            if not workers:
                return await self._start_anew(name, folder, cameras)
            # Each reload has a new number, so that a late report of a failed reload is not taken
            # for a report of the next reload.
            self._last_generation += 1
            generation = self._last_generation
            sent = {name: camera.as_dict() for name, camera in cameras.items()}
            for worker in workers:
                worker.send(load=str(folder.resolve()), generation=generation, cameras=sent)
            reports = await asyncio.gather(
                *(worker.wait_loaded(generation, LOAD_TIMEOUT_S) for worker in workers),
                return_exceptions=True,
            )
            problem = _load_problem(reports)
            if problem is not None:
                for worker in workers:
                    worker.send(drop=generation)
                raise UserError(f"{problem}; the old model stays in use")
            model_hash = str(reports[0]["model"])  # type: ignore[index]
            # After this assignment every worker answers with the new weights.
            self._head[COMMITTED_GENERATION] = generation
            self._folder, self._model, self._model_hash = folder, name, model_hash
            self._cameras = cameras
            logger.info("now serving %s, model %s", folder, model_hash[:12])
            return model_hash

    async def _loaded_workers(self) -> list[WorkerProcess]:
        """Return the living workers once they have loaded the model. A worker that cannot load it
        is stopped."""
        for worker in list(self._workers.values()):
            try:
                await worker.wait_loaded(worker.task.generation, LOAD_TIMEOUT_S)
            except UserError:  # `_replace_dead` logs it
                await worker.stop(STOP_TIMEOUT_S)
        return [worker for worker in self._workers.values() if worker.alive]

    async def _start_anew(
        self, name: str, folder: Path, cameras: Mapping[str, CameraParameters]
    ) -> str:
        """Serve the model in `folder` with one new worker, because no worker is alive;
        `_replace_dead` starts the others. Returns the hash of the weights. Raises UserError; the
        workers are then started with the old model."""
        position, dead = next(iter(self._workers.items()))
        task = self._task(self._free_block(without=dead))
        new, model_hash = await _start_ready(
            replace(task, folder=str(folder.resolve()), expected=None, cameras=cameras)
        )
        self._workers[position] = new
        self._folder, self._model, self._model_hash = folder, name, model_hash
        self._cameras = cameras
        await dead.stop(STOP_TIMEOUT_S)  # closes the socket to it
        logger.info("now serving %s, model %s", folder, model_hash[:12])
        return model_hash

    def _on_hangup(self, reload: Callable[[], None]) -> None:
        """Reload on SIGHUP; stop if the reason of SIGHUP is that the terminal was closed."""
        if self._has_terminal and not _has_terminal():
            self._stopping.set()
        else:
            reload()

    async def restart(self) -> None:
        """Replace the workers one by one; each old worker is stopped once its successor is ready.

        Raises UserError if a new worker does not become ready. Then the new worker is stopped, and
        the old worker stays.
        """
        async with self._change_lock:
            for position, old in list(self._workers.items()):
                new, _ = await _start_ready(self._task(self._free_block()))
                self._workers[position] = new
                await old.stop(STOP_TIMEOUT_S)

    async def _replace_dead(self, position: int) -> None:
        backoff_s = MIN_BACKOFF_S
        while True:
            worker = self._workers[position]
            await worker.wait_exit()
            # A killed worker cannot clear its status: its bodies would still count in the budget.
            WorkerPeers(self._shared, worker.task.block).withdraw()
            if self._workers[position] is not worker:
                backoff_s = MIN_BACKOFF_S
                continue
            stable = worker.age_s() > STABLE_AGE_S
            backoff_s = MIN_BACKOFF_S if stable else min(2 * backoff_s, MAX_BACKOFF_S)
            logger.error("worker %d ended (%s); restarting it", worker.pid, worker.exit_reason())
            await asyncio.sleep(backoff_s)
            async with self._change_lock:
                if self._workers[position] is not worker:
                    continue
                block = self._free_block(without=worker)
                try:
                    self._workers[position] = await start_worker(self._task(block))
                except OSError as error:  # no processes or memory left; tried again
                    logger.error("cannot start a worker: %s", error)
                else:
                    await worker.stop(STOP_TIMEOUT_S)  # closes the socket to it

    def _task(self, block: int) -> WorkerTask:
        return WorkerTask(
            folder=str(self._folder.resolve()),
            generation=self._head[COMMITTED_GENERATION],
            expected=self._model_hash,
            listeners=tuple(listener.fileno() for listener in self._listeners),
            memory=self._shared.fd,
            blocks=self._shared.blocks,
            block=block,
            limits=self._plan.limits,
            cameras=self._cameras,
            views=self._plan.views,
            threads=self._plan.threads,
        )

    def _free_block(self, without: WorkerProcess | None = None) -> int:
        used = {w.task.block for w in self._workers.values() if w is not without}
        return min(set(range(self._shared.blocks)) - used)


async def _start_ready(task: WorkerTask) -> tuple[WorkerProcess, str]:
    """Start a worker and wait until it can answer images; return it and the hash of its weights.
    Raises UserError if it does not become ready; it is then stopped."""
    worker = await start_worker(task)
    try:
        report = await worker.wait_loaded(task.generation, LOAD_TIMEOUT_S)
        await worker.wait_ready(LOAD_TIMEOUT_S)
    except BaseException:  # also if the service is stopped
        await worker.stop(STOP_TIMEOUT_S)
        raise
    return worker, str(report["model"])


def _load_problem(reports: list[Any]) -> str | None:
    """The reason why a reload failed; None if all workers loaded the same weights."""
    for report in reports:
        if isinstance(report, UserError):
            return str(report)
        if isinstance(report, BaseException):
            raise report
    hashes = {report["model"] for report in reports}
    return "the workers loaded different weights" if len(hashes) > 1 else None


def _has_terminal() -> bool:
    try:
        os.close(os.open("/dev/tty", os.O_RDONLY | os.O_NOCTTY))
    except OSError:
        return False
    return True


async def _log_errors(action: Callable[[], Any]) -> None:
    """Run the `action` that a signal requests; UserError and OSError are only logged."""
    try:
        await action()
    except (UserError, OSError) as error:
        logger.error("%s", error)
