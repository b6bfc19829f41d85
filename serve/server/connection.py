"""HTTP connections that cannot be held open for nothing: deadlines, a limit, a bound on headers.

uvicorn's protocol on httptools, with a deadline for the headers and one for the body of each
request. `sweep` looks at them ten times a second, so that a request costs two assignments.
"""

import asyncio
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from enum import Enum, auto
from math import inf
from typing import Any

from uvicorn.protocols.http.httptools_impl import HttpToolsProtocol

from serve.api.http_io import head_of, refusal
from serve.api.problems import (
    HEAD_TOO_LARGE,
    MALFORMED,
    TOO_MANY_CONNECTIONS,
    TOO_SLOW,
    Kind,
    Problem,
)
from serve.config import MAX_HEAD_BYTES, Limits

LINGER_S = 0.5  # for a client to read why it is dismissed, before the connection is cut
EVICTABLE_S = 0.1  # headers or a body that take longer make room for another connection


class Phase(Enum):
    """Where a connection is."""

    HEAD = auto()  # headers are awaited
    BODY = auto()
    WORK = auto()  # the answer is awaited
    IDLE = auto()  # between requests
    DISMISSED = auto()


@dataclass
class Guard:
    """What the connections of a worker share. `others` counts those of the other workers."""

    limits: Limits
    others: Callable[[], int] = lambda: 0
    dismissed: Callable[[Kind], None] = lambda _kind: None
    draining: bool = field(default=False)
    unfinished: dict["GuardedProtocol", None] = field(default_factory=dict)
    """Those in the middle of headers or a body, the one that has been for longest first."""


class GuardedProtocol(HttpToolsProtocol):
    """One HTTP connection."""

    def __init__(self, *arguments: Any, guard: Guard, **named: Any) -> None:
        super().__init__(*arguments, **named)
        self._guard = guard
        self._phase = Phase.HEAD
        self._due = inf
        self._since = 0.0  # when these headers, or this body, began
        self._served = False
        self._head_bytes = 0  # of headers that are too large
        self._part_bytes = 0  # of what came last
        self._unread_bytes = (
            0  # of all that came since the last whole request, and what came with it
        )

    @property
    def active(self) -> bool:
        """Whether it has asked for something, and may soon ask again."""
        return self._served or self._phase in (Phase.BODY, Phase.WORK)

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        super().connection_made(transport)
        self._await(Phase.HEAD)
        limit = self._guard.limits.connections
        if len(self.connections) + self._guard.others() > limit and not self._make_room():
            detail = f"{limit} connections are open already; keep one open for all requests"
            self._dismiss(Problem(TOO_MANY_CONNECTIONS, detail))

    def data_received(self, data: bytes) -> None:
        if self._phase is Phase.DISMISSED:
            return
        if self._phase is Phase.IDLE:
            self._unread_bytes = 0
            self._await(Phase.HEAD)
        self._part_bytes = len(data)
        self._unread_bytes += self._part_bytes
        super().data_received(data)
        # A header that has no end yet is counted as it comes.
        if self._phase is Phase.HEAD and self._unread_bytes > MAX_HEAD_BYTES:
            self._dismiss(_head_too_large())

    def check_head(self) -> None:
        """Go on to the body when the headers are not too large; else an error for the parser."""
        if self._unread_bytes > MAX_HEAD_BYTES:
            self._head_bytes = len(self.url) + sum(len(k) + len(v) for k, v in self.headers)
            if self._head_bytes > MAX_HEAD_BYTES:
                raise ValueError("headers too large")  # ends in `send_400_response`
        self._await(Phase.BODY)

    def on_headers_complete(self) -> None:
        self.check_head()
        super().on_headers_complete()
        if self._guard.draining and self.cycle is not None:
            self.cycle.keep_alive = False

    def body_is_whole(self) -> None:
        """Wait for the answer, unless it was given."""
        self._unread_bytes = self._part_bytes
        if self.cycle is None or self.cycle.response_complete:
            self._rest()
        else:
            self._leave(Phase.WORK)

    def on_message_complete(self) -> None:
        self.body_is_whole()
        super().on_message_complete()

    def on_response_complete(self) -> None:
        self._served = True
        if self.pipeline:
            super().on_response_complete()
            return
        self.server_state.total_requests += 1
        self.flow.resume_reading()
        if self._phase is Phase.WORK:
            self._rest()

    def connection_lost(self, exc: Exception | None) -> None:
        self._leave(Phase.DISMISSED)
        super().connection_lost(exc)

    def _rest(self) -> None:
        """Wait for the next request."""
        self._leave(Phase.IDLE)
        self._due = self.loop.time() + self._guard.limits.idle_s

    def _await(self, phase: Phase) -> None:
        """Wait for headers or a body that began now."""
        limits, unfinished = self._guard.limits, self._guard.unfinished
        self._phase, self._since = phase, self.loop.time()
        self._due = self._since + (limits.head_s if phase is Phase.HEAD else limits.body_s)
        unfinished.pop(self, None)
        unfinished[self] = None

    def _leave(self, phase: Phase) -> None:
        """Wait no more for headers or a body."""
        self._phase, self._due = phase, inf
        self._guard.unfinished.pop(self, None)

    def handle_websocket_upgrade(self) -> None:
        self._leave(Phase.WORK)
        super().handle_websocket_upgrade()

    def send_400_response(self, msg: str) -> None:
        if self._head_bytes > MAX_HEAD_BYTES:
            self._dismiss(_head_too_large())
        else:
            self._dismiss(
                Problem(MALFORMED, "the bytes on this connection are no HTTP/1.1 request")
            )

    def _unsupported_upgrade_warning(self) -> None:
        """An upgrade that is not taken is no event: the request is answered as it is."""

    def expire(self, now: float) -> None:
        """Dismiss the client when its deadline has passed."""
        if now < self._due:
            return
        if self._phase is Phase.IDLE:
            self._due = inf
            # Closed in peace, unless it asked and never read the answer.
            unread = self.transport.get_write_buffer_size()
            (self.transport.abort if unread else self.transport.close)()
            return
        what, within = "headers", self._guard.limits.head_s
        if self._phase is Phase.BODY:
            what, within = "body", self._guard.limits.body_s
        if self._phase is Phase.HEAD and not self._unread_bytes:
            self._leave(Phase.DISMISSED)
            self.transport.abort()  # it never asked for anything
            return
        self._dismiss(Problem(TOO_SLOW, f"the {what} did not come within {within:g} s"))

    def _make_room(self) -> bool:
        """Cut the connection that has sent too little for longest; False where there is none."""
        oldest = next(iter(self._guard.unfinished))  # at the latest this one itself
        if self.loop.time() - oldest._since <= EVICTABLE_S:
            return False
        oldest._leave(Phase.DISMISSED)
        oldest.transport.abort()
        self._guard.dismissed(TOO_MANY_CONNECTIONS)
        return True

    def _dismiss(self, problem: Problem) -> None:
        """Say why, and cut the connection."""
        self._leave(Phase.DISMISSED)
        self._guard.dismissed(problem.kind)
        if self.cycle is not None and not self.cycle.response_complete:
            self.cycle.disconnected = True
            self.cycle.message_event.set()
        self._unset_keepalive_if_required()
        if self.transport.is_closing():
            return
        whole = refusal(problem, (b"connection", b"close"))
        self.transport.write(head_of(whole) + whole.body)
        # Cut at once, the answer would be lost to whoever is still sending.
        if self.transport.can_write_eof():
            self.transport.write_eof()
        self.loop.call_later(LINGER_S, self.transport.abort)


def sweep(connections: Iterable[object], now: float) -> None:
    """Dismiss those whose deadline has passed."""
    for connection in list(connections):
        if isinstance(connection, GuardedProtocol):
            connection.expire(now)


def _head_too_large() -> Problem:
    return Problem(HEAD_TOO_LARGE, f"the headers have over {MAX_HEAD_BYTES} bytes; send fewer")
