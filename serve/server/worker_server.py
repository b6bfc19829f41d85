"""The server of one worker: it shares new connections with the other workers, and drains its own
connections when it stops.

All workers listen on the same sockets, and a new connection wakes all of them; the worker with the
fewest connections accepts it. (If the kernel chose, one of two workers could get six of eight
clients and keep them for hours.) While a worker warms up, it leaves connections to ready workers.
"""

import asyncio
import errno
import logging
import signal
import socket
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from typing import Any, cast

import uvicorn

from serve.app import Service
from serve.config import MAX_BODY_BYTES, Limits, ipv4_mapped
from serve.server.fast_path import DirectProtocol
from serve.server.guard import ConnectionGuard, Drained
from serve.server.heap import HeapTrimmer
from serve.server.websocket import GuardedWebSocket
from serve.shared_memory import WorkerPeers

GRACE_S = 5  # time for requests in progress when the service stops
LAST_S = 1.0  # time after GRACE_S for clients to read why they got no answer
DRAIN_STEP_S = 0.02
YIELD_S = 0.002  # pause in which a worker with fewer connections can accept a new connection
ACCEPTS_AT_ONCE, ACCEPTS_PER_S = 32, 1_000  # more would delay the requests of other clients
ACCEPT_PAUSE_S = 0.004  # pause in accepting after too many new connections
TRIM_TICKS = 50  # ticks of 0.1 s between two trims of the heap
NO_DESCRIPTOR_PAUSE_S = 0.1  # pause in accepting when the system has no more file descriptors

logger = logging.getLogger(__name__)


class WorkerServer(uvicorn.Server):
    """uvicorn's server, extended by shared accepting, deadlines and draining."""

    def __init__(self, app: Service, limits: Limits, peers: WorkerPeers | None = None) -> None:
        self.guard = ConnectionGuard(
            limits,
            other_connections=lambda: sum(self._peers.other_connections()),
            ask_for_room=lambda least: self._peers.ask_for_room(least),
            count_closed=app.metrics.count_closed,
            bodies=app.bodies,
        )
        app.bodies.end_slow_bodies = self.guard.end_slow_bodies
        super().__init__(_uvicorn_config(app))
        self.app = app
        self._peers = peers or WorkerPeers(app.shared, 0)
        self._yielded = False
        self._accepts, self._accepts_counted_s = float(ACCEPTS_AT_ONCE), 0.0
        self._trim_heap = HeapTrimmer()

    @contextmanager
    def capture_signals(self) -> Iterator[None]:
        """Within the context, stop the worker on SIGTERM, and ignore SIGINT, SIGHUP and SIGUSR2,
        which the supervisor handles."""
        if threading.current_thread() is threading.main_thread():
            signal.signal(signal.SIGTERM, self.handle_exit)
            for number in (signal.SIGINT, signal.SIGHUP, signal.SIGUSR2):
                signal.signal(number, signal.SIG_IGN)
        yield

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        """Start the application, then accept connections from the listening sockets."""
        assert sockets is not None
        await self.lifespan.startup()
        if self.lifespan.should_exit:
            raise SystemExit(1)
        self.servers = []
        self._listeners = sockets
        for listener in sockets:
            listener.setblocking(False)
        self._loop = asyncio.get_running_loop()
        self._make_protocol = partial(
            DirectProtocol,
            service=self.app,
            guard=self.guard,
            config=self.config,
            server_state=self.server_state,
            app_state=self.lifespan.state,
            _loop=self._loop,
        )
        self._start_accepting()
        self.started = True

    async def on_tick(self, counter: int) -> bool:
        """Close expired connections, and one connection if another worker asked for room; publish
        this worker's status; return free memory every 50th tick. uvicorn calls this method ten
        times per second with the number of the tick, and ends the server if it returns True."""
        self._close_expired()
        self._make_room_for_others()
        self._publish_status()
        if counter % TRIM_TICKS == 0:
            self._loop.run_in_executor(None, self._trim_heap)
        return await super().on_tick(counter)

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        """Stop accepting connections, then finish the requests of the open connections.

        New connections are accepted by other workers, or by the supervisor if the service stops.
        """
        self._remove_readers()
        self.guard.draining = True
        self._peers.withdraw()
        for connection in self._connections():
            connection.begin_draining()
        await self._wait_for(lambda c, elapsed_s: c.drain(elapsed_s), GRACE_S)
        for connection in self._connections():
            connection.end_draining()
        await self._wait_for(lambda c, _elapsed_s: not c.lingers, LAST_S)
        await super().shutdown(sockets)

    async def _wait_for(self, is_done: Callable[[Drained, float], bool], limit_s: float) -> None:
        """Wait until `is_done` holds for all connections, at most `limit_s`."""
        start_s = self._loop.time()
        while not self.force_exit and (elapsed_s := self._loop.time() - start_s) < limit_s:
            await asyncio.sleep(DRAIN_STEP_S)  # first, to include connections accepted just now
            self._close_expired()
            done = [is_done(connection, elapsed_s) for connection in self._connections()]
            if all(done):
                break

    def _close_expired(self) -> None:
        """Close the connections whose deadline has passed."""
        now = self.guard.clock()
        for connection in self._connections():
            connection.expire(now)

    def _connections(self) -> list[Drained]:
        return list(cast("set[Drained]", self.server_state.connections))

    def _make_room_for_others(self) -> None:
        least = self._peers.room_asked()
        count = len(self.server_state.connections) + self.guard.other_connections()
        if least is not None and count >= self.guard.limits.connections:
            # One per tick: many refused clients must not end all idle connections at once.
            self.guard.make_room(1, least)

    def _start_accepting(self) -> None:
        for listener in self._listeners:
            self._loop.add_reader(listener.fileno(), self._accept, listener)

    def _remove_readers(self) -> None:
        for listener in self._listeners:
            self._loop.remove_reader(listener.fileno())

    def _pause_accepting(self, seconds: float) -> None:
        self._remove_readers()
        self._loop.call_later(seconds, self._resume_accepting)

    def _resume_accepting(self) -> None:
        if not self.guard.draining:
            self._start_accepting()

    def _accept(self, listener: socket.socket) -> None:
        if not self.app.frame_queue.ready and self._peers.other_is_ready():
            self._pause_accepting(YIELD_S)
            return
        own, others = len(self.server_state.connections), self._peers.other_connections()
        if others and own > min(others) and not self._yielded:
            self._yielded = True  # yield only once, in case the other worker hangs
            self._pause_accepting(YIELD_S)
            return
        self._yielded = False
        if not self._may_accept():
            self._pause_accepting(ACCEPT_PAUSE_S)
            return
        try:
            connection, _ = listener.accept()
        except (BlockingIOError, InterruptedError, ConnectionAbortedError):
            return
        except OSError as error:
            if error.errno not in (errno.EMFILE, errno.ENFILE, errno.ENOBUFS, errno.ENOMEM):
                raise
            logger.error("cannot accept a connection: %s", error.strerror)
            self._pause_accepting(NO_DESCRIPTOR_PAUSE_S)
            return
        connection.setblocking(False)
        task = self._loop.create_task(self._serve_connection(connection))
        self.server_state.tasks.add(task)
        task.add_done_callback(self.server_state.tasks.discard)

    def _may_accept(self) -> bool:
        """Count a new connection; return False if connections arrive at more than the allowed
        rate."""
        now = self._loop.time()
        earned = (now - self._accepts_counted_s) * ACCEPTS_PER_S
        self._accepts = min(self._accepts + earned, ACCEPTS_AT_ONCE)
        self._accepts_counted_s = now
        if self._accepts < 1.0:
            return False
        self._accepts -= 1.0
        return True

    async def _serve_connection(self, connection: socket.socket) -> None:
        await self._loop.connect_accepted_socket(self._make_protocol, connection)
        self._publish_status()

    def _publish_status(self) -> None:
        self._peers.publish(len(self.server_state.connections), self.app.frame_queue.ready)


def _uvicorn_config(app: Any) -> uvicorn.Config:
    proxies = app.limits.trusted_proxies or ("127.0.0.1",)
    return uvicorn.Config(
        app,
        loop="uvloop",
        http="httptools",
        ws=GuardedWebSocket,
        ws_max_size=MAX_BODY_BYTES,
        ws_per_message_deflate=False,  # images are compressed already
        lifespan="on",
        log_config=None,
        access_log=False,
        server_header=False,
        timeout_graceful_shutdown=GRACE_S,
        # Never None: with None uvicorn reads an environment variable.
        forwarded_allow_ips=[*proxies, *ipv4_mapped(proxies)],
    )
