"""The parent of the workers: starts them, replaces those that die, brings in new weights.

It answers no request and loads no engine. SIGTERM and SIGINT end the service, SIGHUP loads the
model anew, SIGUSR2 replaces the workers one by one; `serve reload` and `serve restart` ask for the
same over a Unix socket and hear how it went.
"""

import asyncio
import logging
import os
import signal
import socket
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from serve.config import Limits
from serve.workers.shared_memory import COMMITTED, Shared, create
from serve.workers.worker_process import Child, Task, start
from trackfeatures.errors import UserError

LOAD_S = 120.0  # for a worker to load a model, on a machine that is busy
STOP_S = 15.0  # for a worker to end when told to; then it is killed
FIRST_PAUSE_S, LONGEST_PAUSE_S = 0.5, 30.0  # before a worker that died is replaced
STEADY_S = 10.0  # a worker that lived for so long did not die of its start

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class ServicePlan:
    """What is served, by how many. `resolve` gives the folder of a model's name, or raises."""

    model: str
    resolve: Callable[[str], Path]
    workers: int
    limits: Limits


class Supervisor:
    """The workers of one service."""

    def __init__(self, plan: ServicePlan, listener: socket.socket) -> None:
        self._plan = plan
        self._listener = listener
        # One more than workers: a replacement runs beside the worker that it replaces.
        self._shared: Shared = create(slots=plan.workers + 1)
        self._head = self._shared.head()
        self._children: dict[int, Child] = {}
        self._folder = plan.resolve(plan.model)
        self._model = plan.model
        self._hash: str | None = None
        self._changing = asyncio.Lock()
        self._stopping = asyncio.Event()
        self._terminal = _has_terminal()

    @property
    def folder(self) -> Path:
        """The folder of the model that is served."""
        return self._folder

    async def start(self) -> dict[str, Any]:
        """Start all workers; what the first says of its engine. Raises UserError."""
        loop = asyncio.get_running_loop()
        for number in (signal.SIGTERM, signal.SIGINT):
            loop.add_signal_handler(number, self._stopping.set)
        for slot in range(self._plan.workers):
            self._children[slot] = await self._start(slot)
        try:
            answers = [await child.loaded(0, LOAD_S) for child in self._children.values()]
        except UserError:
            await self._stop()
            raise
        self._hash = answers[0]["model"]
        return answers[0]

    async def run(self) -> None:
        """Watch over the workers until told to stop."""
        loop = asyncio.get_running_loop()
        tasks: set[asyncio.Task[Any]] = set()

        def begin(what: Callable[[], Any]) -> None:
            task = asyncio.ensure_future(_told(what))
            tasks.add(task)
            task.add_done_callback(tasks.discard)

        loop.add_signal_handler(signal.SIGHUP, self._on_hangup, lambda: begin(self.reload))
        loop.add_signal_handler(signal.SIGUSR2, begin, self.restart)
        watchers = [asyncio.ensure_future(self._watch(slot)) for slot in range(self._plan.workers)]
        await self._stopping.wait()
        for task in (*watchers, *tasks):
            task.cancel()
        await self._stop()

    async def _stop(self) -> None:
        await asyncio.gather(*(child.stop(STOP_S) for child in self._children.values()))

    async def reload(self, model: str | None = None) -> str:
        """Load `model`, None: the one served, anew in all workers, then answer with it.

        Gives its hash. Raises UserError, and then the old one goes on answering.
        """
        async with self._changing:
            name = model or self._model
            folder = self._plan.resolve(name)
            generation = self._head[COMMITTED] + 1
            children = [child for child in self._children.values() if child.alive]
            if not children:
                raise UserError("no worker is alive; they are being started")
            for child in children:
                child.say(load=str(folder.resolve()), generation=generation)
            answers = await asyncio.gather(
                *(child.loaded(generation, LOAD_S) for child in children), return_exceptions=True
            )
            fault = self._fault(answers)
            if fault is not None:
                for child in children:
                    child.say(drop=generation)
                raise UserError(f"{fault}; the old model goes on answering")
            found = str(answers[0]["model"])  # type: ignore[index]
            # From this instant on every worker answers with the new weights.
            self._head[COMMITTED] = generation
            self._folder, self._model, self._hash = folder, name, found
            logger.info("now serving %s, model %s", folder, found[:12])
            return found

    def _on_hangup(self, reload: Callable[[], None]) -> None:
        """SIGHUP is also what a terminal sends that closes: then it is the end."""
        if self._terminal and not _has_terminal():
            self._stopping.set()
        else:
            reload()

    @staticmethod
    def _fault(answers: list[Any]) -> str | None:
        for answer in answers:
            if isinstance(answer, UserError):
                return str(answer)
            if isinstance(answer, BaseException):
                raise answer
        hashes = {answer["model"] for answer in answers}
        return "the workers loaded different weights" if len(hashes) > 1 else None

    async def restart(self) -> None:
        """Replace the workers one by one; each goes only when its replacement is ready."""
        async with self._changing:
            for slot, old in list(self._children.items()):
                new = await self._start(self._free_slot())
                await new.loaded(self._head[COMMITTED], LOAD_S)
                await new.ready(LOAD_S)
                self._children[slot] = new
                await old.stop(STOP_S)

    async def _watch(self, slot: int) -> None:
        pause = FIRST_PAUSE_S
        while True:
            child = self._children[slot]
            await child.ended()
            if self._children[slot] is not child:
                pause = FIRST_PAUSE_S
                continue
            pause = FIRST_PAUSE_S if child.age() > STEADY_S else min(2 * pause, LONGEST_PAUSE_S)
            logger.error("worker %d ended (%s); starting another", child.pid, child.how_ended())
            await asyncio.sleep(pause)
            async with self._changing:
                if self._children[slot] is child:
                    self._children[slot] = await self._start(self._free_slot(without=child))

    async def _start(self, place: int) -> Child:
        task = Task(
            folder=str(self._folder.resolve()),
            generation=self._head[COMMITTED],
            expected=self._hash,
            listener=self._listener.fileno(),
            memory=self._shared.fd,
            slots=self._shared.slots,
            slot=place,
            limits=self._plan.limits,
        )
        return await start(task)

    def _free_slot(self, without: Child | None = None) -> int:
        used = {c.task.slot for c in self._children.values() if c is not without}
        return min(set(range(self._shared.slots)) - used)


def _has_terminal() -> bool:
    try:
        os.close(os.open("/dev/tty", os.O_RDONLY | os.O_NOCTTY))
    except OSError:
        return False
    return True


async def _told(what: Callable[[], Any]) -> None:
    """Do what a signal asked for; nobody but the log hears that it failed."""
    try:
        await what()
    except UserError as error:
        logger.error("%s", error)
