"""Starts a worker process, exchanges messages with it and stops it, for the supervisor.

`serve.worker` describes the messages between the two processes.
"""

import asyncio
import json
import logging
import socket
import sys
import time
from asyncio.subprocess import Process
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any

from serve.config import Limits
from trackfeatures.camera import CameraParameters, stored
from trackfeatures.errors import UserError

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class WorkerTask:
    """The configuration of a new worker, which the supervisor sends as its first message.

    `folder`: folder of the model; `generation`: number of its weights, see `serve.worker`;
    `expected`: required hash of the weights, None accepts any. `listeners` and `memory`: inherited
    file descriptors of the listening sockets and of the shared memory. `block`: number of the
    worker's block of the shared memory, which has `blocks` blocks. `cameras`: the cameras that
    clients can name, by name. `views`: number of views of each image whose answers are averaged.
    `threads`: number of threads that compute an answer.
    """

    folder: str
    generation: int
    expected: str | None
    listeners: tuple[int, ...]
    memory: int
    blocks: int
    block: int
    limits: Limits
    cameras: Mapping[str, CameraParameters] = field(default_factory=dict)
    views: int = 1
    threads: int = 1

    def to_json_line(self) -> bytes:
        """Return the task as one line of JSON."""
        return json.dumps(asdict(self, dict_factory=stored)).encode() + b"\n"

    @classmethod
    def from_json_line(cls, line: str) -> "WorkerTask":
        """Read the task from a line of JSON."""
        content = json.loads(line)
        limits, cameras = Limits(**content["limits"]), read_cameras(content["cameras"])
        return cls(**{**content, "limits": limits, "cameras": cameras})


def read_cameras(content: dict[str, dict[str, Any]]) -> dict[str, CameraParameters]:
    """Return the cameras in a message of the supervisor, by name."""
    return {name: CameraParameters(**values) for name, values in content.items()}


class WorkerProcess:
    """A running worker process and the messages received from it."""

    def __init__(
        self,
        task: WorkerTask,
        process: Process,
        reader: asyncio.StreamReader,
        writer: asyncio.StreamWriter,
    ) -> None:
        self.task = task
        self.pid = process.pid
        self._process = process
        self._writer = writer
        self._started_s = time.monotonic()
        self._load_results: dict[int, asyncio.Future[dict[str, Any]]] = {}
        self._ready = asyncio.Event()
        self._start_error = ""
        self._reading = asyncio.ensure_future(self._read_messages(reader))

    @property
    def alive(self) -> bool:
        """Whether the process is running."""
        return self._process.returncode is None

    def age_s(self) -> float:
        """Return the time since the start of the process in s."""
        return time.monotonic() - self._started_s

    def exit_reason(self) -> str:
        """Return the error that the worker reported at its start; if there is none, its exit code
        or signal."""
        if self._start_error:
            return self._start_error
        code = self._process.returncode
        return f"signal {-code}" if code is not None and code < 0 else f"exit code {code}"

    def send(self, **message: Any) -> None:
        """Send the keyword arguments to the worker as a JSON message."""
        self._writer.write(json.dumps(message).encode() + b"\n")

    async def wait_loaded(self, generation: int, timeout_s: float) -> dict[str, Any]:
        """Wait until the worker has loaded a generation of weights; return its report ("model",
        "engine", "precision"). Raises UserError if the worker failed, ended or exceeded
        `timeout_s`."""
        result = self._load_result(generation)
        if self._reading.done():
            self._fail_pending_loads()
        try:
            message = await asyncio.wait_for(asyncio.shield(result), timeout_s)
        except TimeoutError:
            raise UserError(
                f"worker {self.pid} did not load the model within {timeout_s:g} s"
            ) from None
        if "failed" in message:
            raise UserError(message["why"])
        return message

    async def wait_ready(self, timeout_s: float) -> None:
        """Wait until the worker can answer images. Raises UserError if the worker ends before that,
        or is not ready after `timeout_s` (s)."""
        waits = [asyncio.ensure_future(w) for w in (self._ready.wait(), self.wait_exit())]
        await asyncio.wait(waits, timeout=timeout_s, return_when=asyncio.FIRST_COMPLETED)
        for wait in waits:
            wait.cancel()
        if not self.alive:
            raise UserError(f"worker {self.pid} ended before it was ready ({self.exit_reason()})")
        if not self._ready.is_set():
            raise UserError(f"worker {self.pid} was not ready within {timeout_s:g} s")

    async def wait_exit(self) -> None:
        """Wait until the process has ended."""
        await self._process.wait()

    async def stop(self, timeout_s: float) -> None:
        """Send SIGTERM, and SIGKILL if the process has not ended after `timeout_s` (s)."""
        if self._process.returncode is None:
            self._process.terminate()
            try:
                await asyncio.wait_for(self._process.wait(), timeout_s)
            except TimeoutError:
                logger.error("worker %d did not stop within %g s; killed", self.pid, timeout_s)
                self._process.kill()
                await self._process.wait()
        self._reading.cancel()
        self._writer.close()

    def _load_result(self, generation: int) -> "asyncio.Future[dict[str, Any]]":
        if generation not in self._load_results:
            self._load_results[generation] = asyncio.get_running_loop().create_future()
        return self._load_results[generation]

    async def _read_messages(self, reader: asyncio.StreamReader) -> None:
        async for line in reader:
            message = json.loads(line)
            if "ready" in message:
                self._ready.set()
                continue
            if "failed" in message and not self._ready.is_set():
                self._start_error = message["why"]
            result = self._load_result(message.get("loaded", message.get("failed")))
            if not result.done():
                result.set_result(message)
        await self.wait_exit()
        self._fail_pending_loads()

    def _fail_pending_loads(self) -> None:
        for result in self._load_results.values():
            if not result.done():
                why = f"worker {self.pid} ended while it loaded the model ({self.exit_reason()})"
                result.set_result({"failed": True, "why": why})


async def start_worker(task: WorkerTask) -> WorkerProcess:
    """Start a worker process and send its task. Raises OSError if no process can be started."""
    ours, theirs = socket.socketpair()
    with theirs:
        try:
            process = await asyncio.create_subprocess_exec(
                sys.executable,
                "-m",
                "serve.worker",
                str(theirs.fileno()),
                pass_fds=(theirs.fileno(), *task.listeners, task.memory),
                start_new_session=True,  # Ctrl-C goes to the supervisor only
                stdin=asyncio.subprocess.DEVNULL,
            )
        except BaseException:
            ours.close()
            raise
    ours.setblocking(False)
    reader, writer = await asyncio.open_connection(sock=ours)
    writer.write(task.to_json_line())
    return WorkerProcess(task, process, reader, writer)
