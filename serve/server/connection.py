"""HTTP connections with deadlines, a limit on their number, and a limit on the size of headers.

uvicorn's protocol on httptools, with a deadline for the headers and one for the body of each
request. `close_expired` checks them ten times a second, so that a request costs two assignments.
A WebSocket tells its client why it is closed, also on a message that is too long.
"""

import asyncio
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from enum import Enum, auto
from math import inf
from typing import Any

from uvicorn.protocols.http.httptools_impl import HttpToolsProtocol
from uvicorn.protocols.websockets.websockets_sansio_impl import WebSocketsSansIOProtocol

from serve.api.http_io import encode_head, problem_reply
from serve.api.problems import (
    HEAD_TOO_LARGE,
    MALFORMED,
    TOO_MANY_CONNECTIONS,
    TOO_SLOW,
    Problem,
    ProblemType,
)
from serve.config import MAX_HEAD_BYTES, Limits

LINGER_S = 0.5  # for a client to read the problem before its connection is closed
EVICTABLE_S = 0.1  # connections in headers or a body for longer give way to new ones
REFUSAL_PAUSE_S = 0.002  # for which refused clients are not read while the queue is full


class Phase(Enum):
    """State of a connection."""

    HEAD = auto()  # waiting for headers
    BODY = auto()  # waiting for a body
    WORK = auto()  # waiting for the answer
    IDLE = auto()  # between requests
    CLOSING = auto()


@dataclass
class ConnectionGuard:
    """State that the connections of one worker share."""

    limits: Limits
    other_connections: Callable[[], int] = lambda: 0
    """Counts the connections of the other workers."""
    count_closed: Callable[[ProblemType], None] = lambda _type: None
    clock: Callable[[], float] = time.monotonic
    """Time for the deadlines, s."""
    draining: bool = False
    receiving: dict["GuardedProtocol", None] = field(default_factory=dict)
    """Connections in the middle of headers or a body, the one that began first at the front."""
    paused: list["GuardedProtocol"] = field(default_factory=list)
    """Connections that are not read because they were refused while the queue is full."""

    def pause_reading(self, connection: "GuardedProtocol") -> None:
        """Read no more from a refused client for REFUSAL_PAUSE_S.

        Its next request, and those of others refused meanwhile, are then handled together. Waking
        the loop for each of them would take the core from the engine.
        """
        if not self.paused:
            connection.loop.call_later(REFUSAL_PAUSE_S, self._resume_reading)
        connection.flow.pause_reading()
        self.paused.append(connection)

    def _resume_reading(self) -> None:
        paused, self.paused = self.paused, []
        for connection in paused:
            if not (connection.transport.is_closing() or connection.flow.write_paused):
                connection.flow.resume_reading()


class GuardedProtocol(HttpToolsProtocol):
    """One HTTP connection."""

    def __init__(self, *arguments: Any, guard: ConnectionGuard, **named: Any) -> None:
        super().__init__(*arguments, **named)
        self._guard = guard
        self._phase = Phase.HEAD
        self._deadline_s = inf
        self._phase_start_s = 0.0  # of these headers or this body
        self._served = False
        self._head_bytes = 0  # size of headers that are too large
        self._part_bytes = 0  # received last
        # Received since the last complete request, with the part in which that request ended.
        self._unread_bytes = 0

    @property
    def active(self) -> bool:
        """Whether it has sent a request before, or is sending one, and may soon send another."""
        return self._served or self._phase in (Phase.BODY, Phase.WORK)

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        super().connection_made(transport)
        self._begin_receiving(Phase.HEAD)
        limit = self._guard.limits.connections
        if (
            len(self.connections) + self._guard.other_connections() > limit
            and not self._evict_slowest()
        ):
            detail = f"{limit} connections are open; use one connection for all requests"
            self._close_with(Problem(TOO_MANY_CONNECTIONS, detail))

    def data_received(self, data: bytes) -> None:
        if self._phase is Phase.CLOSING:
            return
        if self._phase is Phase.IDLE:
            self._unread_bytes = 0
            self._begin_receiving(Phase.HEAD)
        self._part_bytes = len(data)
        self._unread_bytes += self._part_bytes
        super().data_received(data)
        # Headers that have not ended yet are counted as they arrive.
        if self._phase is Phase.HEAD and self._unread_bytes > MAX_HEAD_BYTES:
            self._close_with(_head_too_large())

    def check_head(self) -> None:
        """Begin to receive the body. Raises ValueError, for the parser, on too large headers."""
        if self._unread_bytes > MAX_HEAD_BYTES:
            self._head_bytes = len(self.url) + sum(len(k) + len(v) for k, v in self.headers)
            if self._head_bytes > MAX_HEAD_BYTES:
                raise ValueError("headers too large")  # ends in `send_400_response`
        self._begin_receiving(Phase.BODY)

    def on_headers_complete(self) -> None:
        self.check_head()
        super().on_headers_complete()
        if self._guard.draining and self.cycle is not None:
            self.cycle.keep_alive = False

    def on_body_complete(self) -> None:
        """Wait for the answer, unless it was sent."""
        self._unread_bytes = self._part_bytes
        if self.cycle is None or self.cycle.response_complete:
            self._become_idle()
        else:
            self._stop_receiving(Phase.WORK)

    def on_message_complete(self) -> None:
        self.on_body_complete()
        super().on_message_complete()

    def on_response_complete(self) -> None:
        self._served = True
        if self.pipeline:
            super().on_response_complete()
            return
        self.server_state.total_requests += 1
        self.flow.resume_reading()
        if self._phase is Phase.WORK:
            self._become_idle()

    def connection_lost(self, exc: Exception | None) -> None:
        self._stop_receiving(Phase.CLOSING)
        super().connection_lost(exc)

    def _become_idle(self) -> None:
        """Wait for the next request."""
        self._stop_receiving(Phase.IDLE)
        self._deadline_s = self._guard.clock() + self._guard.limits.idle_s

    def _begin_receiving(self, phase: Phase) -> None:
        """Wait for headers or a body, from now on."""
        limits, receiving = self._guard.limits, self._guard.receiving
        self._phase, self._phase_start_s = phase, self._guard.clock()
        limit_s = limits.head_s if phase is Phase.HEAD else limits.body_s
        self._deadline_s = self._phase_start_s + limit_s
        receiving.pop(self, None)
        receiving[self] = None

    def _stop_receiving(self, phase: Phase) -> None:
        """Go to a phase in which no headers or body are expected."""
        self._phase, self._deadline_s = phase, inf
        self._guard.receiving.pop(self, None)

    def handle_websocket_upgrade(self) -> None:
        self._stop_receiving(Phase.WORK)
        super().handle_websocket_upgrade()

    def send_400_response(self, msg: str) -> None:
        if self._head_bytes > MAX_HEAD_BYTES:
            self._close_with(_head_too_large())
        else:
            self._close_with(Problem(MALFORMED, "the bytes received are not an HTTP/1.1 request"))

    def _unsupported_upgrade_warning(self) -> None:
        """Log nothing: a request with an unsupported upgrade is answered without it."""

    def expire(self, now: float) -> None:
        """Close the connection when its deadline has passed."""
        if now < self._deadline_s:
            return
        if self._phase is Phase.IDLE:
            self._deadline_s = inf
            # Abort when the client has not read its answer; close would wait for it.
            unread = self.transport.get_write_buffer_size()
            (self.transport.abort if unread else self.transport.close)()
            return
        part, limit_s = "headers", self._guard.limits.head_s
        if self._phase is Phase.BODY:
            part, limit_s = "body", self._guard.limits.body_s
        if self._phase is Phase.HEAD and not self._unread_bytes:
            self._stop_receiving(Phase.CLOSING)
            self.transport.abort()  # nothing was received: there is nobody to answer
            return
        self._close_with(Problem(TOO_SLOW, f"the {part} did not arrive within {limit_s:g} s"))

    def _evict_slowest(self) -> bool:
        """Abort the connection that has been receiving for longest; False where there is none."""
        oldest = next(iter(self._guard.receiving))  # this one itself, if there is no other
        if self._guard.clock() - oldest._phase_start_s <= EVICTABLE_S:
            return False
        oldest._stop_receiving(Phase.CLOSING)
        oldest.transport.abort()
        self._guard.count_closed(TOO_MANY_CONNECTIONS)
        return True

    def _close_with(self, problem: Problem) -> None:
        """Send a problem and close the connection."""
        self._stop_receiving(Phase.CLOSING)
        self._guard.count_closed(problem.type)
        if self.cycle is not None and not self.cycle.response_complete:
            self.cycle.disconnected = True
            self.cycle.message_event.set()
        self._unset_keepalive_if_required()
        if self.transport.is_closing():
            return
        reply = problem_reply(problem, (b"connection", b"close"))
        self.transport.write(encode_head(reply) + reply.body)
        # Aborted at once, the reply would be lost to a client that is still sending.
        if self.transport.can_write_eof():
            self.transport.write_eof()
        self.loop.call_later(LINGER_S, self.transport.abort)


class GuardedWebSocket(WebSocketsSansIOProtocol):
    """One WebSocket connection."""

    _discarding = False

    def data_received(self, data: bytes) -> None:
        if not self._discarding:
            super().data_received(data)

    def handle_parser_exception(self) -> None:
        """Send the close frame, then discard what the client still sends for LINGER_S.

        A connection closed with unread bytes is reset, and the client would lose the close frame.
        """
        closing = self.conn.close_sent
        assert closing is not None
        self._discarding = self.close_sent = True
        self.stop_keepalive()
        self.queue.put_nowait(
            {"type": "websocket.disconnect", "code": closing.code, "reason": closing.reason}
        )
        self.transport.write(b"".join(self.conn.data_to_send()))
        if self.transport.can_write_eof():
            self.transport.write_eof()
        self.close_timer = self.loop.call_later(LINGER_S, self.transport.abort)


def close_expired(connections: Iterable[object], now: float) -> None:
    """Close the connections whose deadline has passed; `now` in s of the guard's clock."""
    for connection in list(connections):
        if isinstance(connection, GuardedProtocol):
            connection.expire(now)


def _head_too_large() -> Problem:
    return Problem(HEAD_TOO_LARGE, f"the headers have more than {MAX_HEAD_BYTES} bytes; send fewer")
