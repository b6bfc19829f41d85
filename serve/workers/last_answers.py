"""Answers connections that arrive while the service stops: the first request of each connection
gets status 503, then the connection is closed.

In the meantime the workers finish the requests of their own connections. If the listening socket
were closed at once, connections that were not accepted yet would be reset. A connection that is
closed with unread bytes is reset too. In both cases the client would not learn the reason.
"""

import asyncio
import socket
from collections.abc import Sequence
from contextlib import suppress

from runtime.sockets import refuse_connections
from serve.problems import stopping
from serve.replies import encode_head, problem_reply

REQUEST_S = 1.0  # time for a new connection to send its request
READ_S = 2.0  # time for a client to send the rest of its request and to read the answer
HANDSHAKE_S = 0.1  # time to complete the TCP handshakes that have begun
MAX_LINE = 1 << 16  # largest size of a request line in bytes
MAX_OPEN = 512  # largest number of open connections


class LastAnswers:
    """Accepts connections while the service stops. Call `start`, then `finish`."""

    def __init__(self, listeners: Sequence[socket.socket]) -> None:
        self._listeners = listeners
        self._open: dict[LastAnswer, None] = {}
        self._loop = asyncio.get_running_loop()
        self._tasks: set[asyncio.Task[object]] = set()

    def start(self) -> None:
        """Start accepting connections; workers can still accept too."""
        for listener in self._listeners:
            listener.setblocking(False)
            self._loop.add_reader(listener, self._accept, listener)

    async def finish(self) -> None:
        """Refuse new connections, answer the open ones, then close the listening sockets."""
        for listener in self._listeners:
            refuse_connections(listener)
        await asyncio.sleep(HANDSHAKE_S)
        while self._open or self._tasks:
            await asyncio.sleep(0.01)
        for listener in self._listeners:
            self._loop.remove_reader(listener)
            listener.close()

    def _accept(self, listener: socket.socket) -> None:
        with suppress(OSError):  # a worker has accepted it, or the client has left
            connection, _ = listener.accept()
            connection.setblocking(False)
            make = self._loop.connect_accepted_socket(lambda: LastAnswer(self._open), connection)
            task: asyncio.Task[object] = self._loop.create_task(make)
            self._tasks.add(task)
            task.add_done_callback(self._tasks.discard)


class LastAnswer(asyncio.Protocol):
    """One connection: waits for a request, answers it, and reads until the client closes."""

    def __init__(self, others: "dict[LastAnswer, None]") -> None:
        self._open = others
        self._head = b""
        self._answered = False

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        assert isinstance(transport, asyncio.Transport)
        self._transport = transport
        if len(self._open) >= MAX_OPEN:
            next(iter(self._open))._transport.abort()
        self._open[self] = None
        self._limit(REQUEST_S)

    def data_received(self, data: bytes) -> None:
        if self._answered:
            return
        self._head += data
        line, end, _ = self._head.partition(b"\r\n")
        if end or len(self._head) > MAX_LINE:
            self._answer(*line[:MAX_LINE].split(b" ")[:2])

    def connection_lost(self, exc: Exception | None) -> None:
        self._timer.cancel()
        self._open.pop(self, None)

    def _answer(self, method: bytes = b"", path: bytes = b"") -> None:
        self._answered, self._head = True, b""
        reply = problem_reply(stopping(), (b"connection", b"close"), path=path.decode("latin-1"))
        body = b"" if method == b"HEAD" else reply.body
        self._transport.write(encode_head(reply) + body)
        self._transport.write_eof()
        self._timer.cancel()
        self._limit(READ_S)

    def _limit(self, seconds: float) -> None:
        loop = asyncio.get_running_loop()
        self._timer = loop.call_later(seconds, self._transport.abort)
