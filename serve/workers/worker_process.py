"""What a supervisor tells a new worker to do."""

import asyncio
import json
import logging
import socket
import sys
import time
from asyncio.subprocess import Process
from dataclasses import asdict, dataclass
from typing import Any

from serve.config import Limits
from trackfeatures.errors import UserError


@dataclass(frozen=True)
class Task:
    """What a worker is to do. `expected` is the hash its weights must have, None: any."""

    folder: str
    generation: int
    expected: str | None
    listener: int
    memory: int
    slots: int
    slot: int
    limits: Limits

    def as_line(self) -> bytes:
        """As it goes over the socket."""
        return json.dumps(asdict(self)).encode() + b"\n"


def read_task(line: str) -> Task:
    """The task in a line."""
    content = json.loads(line)
    return Task(**{**content, "limits": Limits(**content["limits"])})


# A worker process, seen from its supervisor: `serve.workers.worker` says what goes over the
# socket.


logger = logging.getLogger(__name__)


class Child:
    """A worker process and what it has said."""

    def __init__(
        self,
        task: Task,
        process: Process,
        reader: asyncio.StreamReader,
        writer: asyncio.StreamWriter,
    ) -> None:
        self.task = task
        self.pid = process.pid
        self._process = process
        self._writer = writer
        self._began = time.monotonic()
        self._answers: dict[int, asyncio.Future[dict[str, Any]]] = {}
        self._ready = asyncio.Event()
        self._why = ""
        self._listening = asyncio.ensure_future(self._listen(reader))

    def age(self) -> float:
        """Since its start, s."""
        return time.monotonic() - self._began

    def how_ended(self) -> str:
        """What it said was wrong, else its exit code or the signal that ended it."""
        if self._why:
            return self._why
        code = self._process.returncode
        return f"signal {-code}" if code is not None and code < 0 else f"exit code {code}"

    def say(self, **message: Any) -> None:
        """Send it a message."""
        self._writer.write(json.dumps(message).encode() + b"\n")

    @property
    def alive(self) -> bool:
        """Whether the process still runs."""
        return self._process.returncode is None

    async def loaded(self, generation: int, within_s: float) -> dict[str, Any]:
        """What it says of the engine it loaded. Raises UserError when it could not."""
        answer = self._answer(generation)
        if self._listening.done():
            self._give_up()
        try:
            message = await asyncio.wait_for(asyncio.shield(answer), within_s)
        except TimeoutError:
            raise UserError(f"worker {self.pid} loaded no model in {within_s:g} s") from None
        if "failed" in message:
            raise UserError(message["why"])
        return message

    async def ready(self, within_s: float) -> None:
        """Return once it answers images. Raises UserError."""
        waits = [asyncio.ensure_future(w) for w in (self._ready.wait(), self.ended())]
        await asyncio.wait(waits, timeout=within_s, return_when=asyncio.FIRST_COMPLETED)
        for wait in waits:
            wait.cancel()
        if not self._ready.is_set():
            raise UserError(f"worker {self.pid} was not ready within {within_s:g} s")

    async def ended(self) -> None:
        """Return once the process is gone."""
        await self._process.wait()

    async def stop(self, within_s: float) -> None:
        """End it in peace, by force where it does not."""
        if self._process.returncode is None:
            self._process.terminate()
            try:
                await asyncio.wait_for(self._process.wait(), within_s)
            except TimeoutError:
                logger.error("worker %d does not end; killed", self.pid)
                self._process.kill()
                await self._process.wait()
        self._listening.cancel()
        self._writer.close()

    def _answer(self, generation: int) -> "asyncio.Future[dict[str, Any]]":
        if generation not in self._answers:
            self._answers[generation] = asyncio.get_running_loop().create_future()
        return self._answers[generation]

    async def _listen(self, reader: asyncio.StreamReader) -> None:
        async for line in reader:
            message = json.loads(line)
            if "ready" in message:
                self._ready.set()
                continue
            self._why = message.get("why", "")
            answer = self._answer(message.get("loaded", message.get("failed")))
            if not answer.done():
                answer.set_result(message)
        await self.ended()
        self._give_up()

    def _give_up(self) -> None:
        for answer in self._answers.values():
            if not answer.done():
                why = f"worker {self.pid} ended while it loaded the model ({self.how_ended()})"
                answer.set_result({"failed": True, "why": why})


async def start(task: Task) -> Child:
    """A new worker process at its task."""
    ours, theirs = socket.socketpair()
    with theirs:
        process = await asyncio.create_subprocess_exec(
            sys.executable,
            "-m",
            "serve.workers.worker",
            str(theirs.fileno()),
            pass_fds=(theirs.fileno(), task.listener, task.memory),
            start_new_session=True,  # Ctrl-C is for the supervisor
            stdin=asyncio.subprocess.DEVNULL,
        )
    ours.setblocking(False)
    reader, writer = await asyncio.open_connection(sock=ours)
    writer.write(task.as_line())
    return Child(task, process, reader, writer)
