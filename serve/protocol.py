"""HTTP connections that cannot be held open for nothing: deadlines, a limit, a bound on headers.

uvicorn's protocol on httptools, with a deadline for the headers and one for the body of each
request. `sweep` looks at them ten times a second, so that a request costs two assignments.
"""

import asyncio
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from enum import Enum, auto
from http import HTTPStatus
from math import inf
from typing import Any

from uvicorn.protocols.http.httptools_impl import HttpToolsProtocol

from serve.gate import PROBLEM_HEADER, encode_problem
from serve.limits import MAX_HEAD_BYTES, Limits
from serve.problems import HEAD_TOO_LARGE, MALFORMED, TOO_MANY_CONNECTIONS, TOO_SLOW, Kind, Problem

LINGER_S = 0.5  # for a client to read why it was dismissed, before the connection is cut
EVICTABLE_S = 0.5  # a connection that asked for nothing for so long makes room for another


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


class GuardedProtocol(HttpToolsProtocol):
    """One HTTP connection."""

    def __init__(self, *arguments: Any, guard: Guard, **named: Any) -> None:
        super().__init__(*arguments, **named)
        self._guard = guard
        self._phase = Phase.HEAD
        self._due = inf
        self._since = 0.0
        self._served = False
        self._head_bytes = 0  # of whole headers
        self._unread_bytes = 0  # of all that came since the last whole request

    @property
    def active(self) -> bool:
        """Whether it has asked for something, and may soon ask again."""
        return self._served or self._phase in (Phase.BODY, Phase.WORK)

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        super().connection_made(transport)
        self._since = self.loop.time()
        self._due = self._since + self._guard.limits.head_s
        limit = self._guard.limits.connections
        if len(self.connections) + self._guard.others() > limit and not self._make_room():
            detail = f"{limit} connections are open already; keep one open for all requests"
            self._dismiss(Problem(TOO_MANY_CONNECTIONS, detail))

    def data_received(self, data: bytes) -> None:
        if self._phase is Phase.DISMISSED:
            return
        if self._phase is Phase.IDLE:
            self._phase, self._head_bytes, self._unread_bytes = Phase.HEAD, 0, 0
            self._due = self.loop.time() + self._guard.limits.head_s
        super().data_received(data)
        if self._phase is Phase.HEAD:
            # A header that has no end yet is counted as it comes.
            self._unread_bytes += len(data)
            if self._unread_bytes > MAX_HEAD_BYTES:
                self._dismiss(_head_too_large())

    def on_url(self, url: bytes) -> None:
        self._head_bytes += len(url)
        super().on_url(url)

    def on_header(self, name: bytes, value: bytes) -> None:
        self._head_bytes += len(name) + len(value)
        super().on_header(name, value)

    def on_headers_complete(self) -> None:
        if self._head_bytes > MAX_HEAD_BYTES:
            raise ValueError("headers too large")  # ends in `send_400_response`
        self._phase, self._head_bytes = Phase.BODY, 0
        self._due = self.loop.time() + self._guard.limits.body_s
        super().on_headers_complete()
        if self._guard.draining and self.cycle is not None:
            self.cycle.keep_alive = False

    def on_message_complete(self) -> None:
        self._due = inf
        done = self.cycle is None or self.cycle.response_complete
        self._phase = Phase.IDLE if done else Phase.WORK
        super().on_message_complete()

    def on_response_complete(self) -> None:
        self._served = True
        if self._phase is Phase.WORK:
            self._phase = Phase.IDLE
        super().on_response_complete()

    def handle_websocket_upgrade(self) -> None:
        self._due = inf
        super().handle_websocket_upgrade()

    def timeout_keep_alive_handler(self) -> None:
        if self.transport.get_write_buffer_size():
            self.transport.abort()  # it asked, and never read the answer
        super().timeout_keep_alive_handler()

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
        what, within = "headers", self._guard.limits.head_s
        if self._phase is Phase.BODY:
            what, within = "body", self._guard.limits.body_s
        if self._phase is Phase.HEAD and not self._unread_bytes:
            self._phase, self._due = Phase.DISMISSED, inf
            self.transport.abort()  # it never asked for anything
            return
        self._dismiss(Problem(TOO_SLOW, f"the {what} did not come within {within:g} s"))

    def _make_room(self) -> bool:
        """Cut the connection that has asked for nothing for longest; False where there is none."""
        now = self.loop.time()
        idle = [
            found
            for found in self.connections
            if isinstance(found, GuardedProtocol)
            and found._phase is Phase.HEAD
            and not found._served
            and now - found._since > EVICTABLE_S
        ]
        if not idle:
            return False
        oldest = min(idle, key=lambda found: found._since)
        oldest._phase, oldest._due = Phase.DISMISSED, inf
        oldest.transport.abort()
        self._guard.dismissed(TOO_MANY_CONNECTIONS)
        return True

    def _dismiss(self, problem: Problem) -> None:
        """Say why, and cut the connection."""
        self._phase, self._due = Phase.DISMISSED, inf
        self._guard.dismissed(problem.kind)
        if self.cycle is not None and not self.cycle.response_complete:
            self.cycle.disconnected = True
            self.cycle.message_event.set()
        self._unset_keepalive_if_required()
        if self.transport.is_closing():
            return
        self.transport.write(_whole_response(problem))
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


def _whole_response(problem: Problem) -> bytes:
    status = problem.kind.status
    body = encode_problem(problem.content)
    headers = [PROBLEM_HEADER, (b"connection", b"close"), (b"content-length", b"%d" % len(body))]
    headers += [(name.encode(), value.encode()) for name, value in problem.headers.items()]
    lines = [b"HTTP/1.1 %d %s" % (status, HTTPStatus(status).phrase.encode())]
    lines += [b"%s: %s" % header for header in headers]
    return b"\r\n".join(lines) + b"\r\n\r\n" + body
