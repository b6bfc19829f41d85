"""The server of one worker: it takes connections in turn with the others, and drains at its end.

All workers listen on one socket and all are woken by a connection; the one with the fewest takes
it. (Left to the kernel, one of two workers may get six of eight cars, and keep them for hours.)
One that is still warming up leaves them to those that can answer.
"""

import asyncio
import errno
import logging
import signal
import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from typing import Any

import uvicorn

from serve.app import Service
from serve.config import MAX_BODY_BYTES, Limits
from serve.server.connection import Guard, GuardedProtocol, sweep
from serve.server.fast_path import DirectProtocol
from serve.server.websocket import GuardedWebSocket
from serve.workers.shared_memory import BlockPeers

GRACE_S = 5  # for requests in progress when the service is told to stop
DRAIN_S = 1.0  # for clients at work to send one more request and be told to connect anew
TURN_S = 0.002  # for which a worker leaves a connection to one that has fewer
REST_S = 0.1  # after the system has no more descriptors

logger = logging.getLogger(__name__)


class WorkerServer(uvicorn.Server):
    """uvicorn with our own accepting, deadlines and draining."""

    def __init__(self, app: Service, limits: Limits, peers: BlockPeers | None = None) -> None:
        self.guard = Guard(
            limits, others=lambda: sum(self._peers.others()), dismissed=app.metrics.dismissed
        )
        super().__init__(_settings(app, limits))
        self._app = app
        self._peers = peers or BlockPeers(app.shared, 0)
        self._waited = False

    @contextmanager
    def capture_signals(self) -> Iterator[None]:
        """SIGTERM ends the worker; Ctrl-C, which all of the group get, is the supervisor's."""
        if threading.current_thread() is threading.main_thread():
            signal.signal(signal.SIGTERM, self.handle_exit)
            for number in (signal.SIGINT, signal.SIGHUP, signal.SIGUSR2):
                signal.signal(number, signal.SIG_IGN)
        yield

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        """Start the application, then take connections from the one listening socket."""
        assert sockets is not None
        await self.lifespan.startup()
        if self.lifespan.should_exit:
            raise SystemExit(1)
        self.servers = []
        self._listener = sockets[0]
        self._listener.setblocking(False)
        self._loop = asyncio.get_running_loop()
        self._make = partial(
            DirectProtocol,
            service=self._app,
            guard=self.guard,
            config=self.config,
            server_state=self.server_state,
            app_state=self.lifespan.state,
            _loop=self._loop,
        )
        self._listen()
        self.started = True

    async def on_tick(self, counter: int) -> bool:
        """Ten times a second."""
        sweep(self.server_state.connections, self._loop.time())
        self._tell()
        return await super().on_tick(counter)

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        """Take no more connections, tell the clients at work, finish what was begun."""
        self._loop.remove_reader(self._listener.fileno())
        self.guard.draining = True
        self._peers.leave()
        end = self._loop.time() + DRAIN_S
        while self._at_work() and self._loop.time() < end and not self.force_exit:
            await asyncio.sleep(0.02)
        await super().shutdown(sockets)

    def _at_work(self) -> bool:
        """Whether a connection is open that may soon ask once more."""
        return any(
            isinstance(found, GuardedProtocol) and found.active
            for found in self.server_state.connections
        )

    def _listen(self) -> None:
        self._loop.add_reader(self._listener.fileno(), self._accept)

    def _rest(self, seconds: float) -> None:
        self._loop.remove_reader(self._listener.fileno())
        self._loop.call_later(seconds, self._resume)

    def _resume(self) -> None:
        if not self.guard.draining:
            self._listen()

    def _accept(self) -> None:
        if not self._app.perceiver.ready and self._peers.other_is_ready():
            self._rest(TURN_S)
            return
        mine, others = len(self.server_state.connections), self._peers.others()
        if others and mine > min(others) and not self._waited:
            self._waited = True  # once: the other may hang
            self._rest(TURN_S)
            return
        self._waited = False
        try:
            connection, _ = self._listener.accept()
        except (BlockingIOError, InterruptedError, ConnectionAbortedError):
            return
        except OSError as error:
            if error.errno not in (errno.EMFILE, errno.ENFILE, errno.ENOBUFS, errno.ENOMEM):
                raise
            logger.error("cannot take a connection: %s", error.strerror)
            self._rest(REST_S)
            return
        connection.setblocking(False)
        task = self._loop.create_task(self._serve_connection(connection))
        self.server_state.tasks.add(task)
        task.add_done_callback(self.server_state.tasks.discard)

    async def _serve_connection(self, connection: socket.socket) -> None:
        await self._loop.connect_accepted_socket(self._make, connection)
        self._tell()

    def _tell(self) -> None:
        self._peers.tell(len(self.server_state.connections), self._app.perceiver.ready)


def _settings(app: Any, limits: Limits) -> uvicorn.Config:
    return uvicorn.Config(
        app,
        loop="uvloop",
        http="httptools",
        ws=GuardedWebSocket,
        ws_max_size=MAX_BODY_BYTES,
        ws_per_message_deflate=False,  # images do not shrink
        lifespan="on",
        log_config=None,
        access_log=False,
        server_header=False,
        timeout_graceful_shutdown=GRACE_S,
    )
