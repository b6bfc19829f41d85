"""HTTP connections with deadlines and with limits for their number and for the size of headers.

This is uvicorn's httptools protocol, extended by a deadline for each phase of a connection.
`WorkerServer` checks the deadlines ten times per second, so a deadline costs a request only a few
assignments. Trailers count as headers and are dropped.
"""

import asyncio
from enum import Enum, auto
from math import inf
from typing import Any

from httptools import HttpParserError, HttpParserUpgrade
from uvicorn.protocols.http.httptools_impl import HttpToolsProtocol, RequestResponseCycle

from serve.config import MAX_DEADLINE_MS, MAX_HEAD_BYTES
from serve.problems import (
    MALFORMED,
    OVERLOADED,
    TOO_MANY_CONNECTIONS,
    Problem,
    head_too_large,
    small_chunks,
    stopping,
    too_many_requests,
    too_slow,
)
from serve.replies import encode_head, problem_reply
from serve.server import guard as guards
from serve.server.guard import ConnectionGuard, Group
from serve.server.lingering_close import LingeringTransport
from serve.server.upgrade import parse_upgrades

# Below, a part means the bytes of one read from the socket.
WORK_S = 2e-3 * MAX_DEADLINE_MS  # longest time for an answer: twice the longest deadline
MAX_PIPELINED = 16  # requests of one connection that wait for the reply to an earlier one
MAX_AT_ONCE = 32  # requests in one part; more would block the event loop
# A body can have FREE_CHUNKS chunks, and one more for each CHUNK_BYTES received.
FREE_CHUNKS, CHUNK_BYTES = 512, 512


class Phase(Enum):
    """State of a connection: what it waits for."""

    HEAD = auto()  # waiting for headers
    BODY = auto()  # waiting for a body
    WORK = auto()  # waiting for the answer
    IDLE = auto()  # between requests
    CLOSING = auto()


class GuardedProtocol(HttpToolsProtocol):
    """One HTTP connection with a deadline for each of its phases."""

    def __init__(self, *arguments: Any, guard: ConnectionGuard, **named: Any) -> None:
        super().__init__(*arguments, **named)
        self.guard = guard
        self.group: Group = {}
        self.network = ""
        self.since_s = 0.0  # start of this phase
        self._phase = Phase.HEAD
        self._settled: Phase | None = None  # the phase for which group and deadline are set
        self._deadline_s = inf
        self._idle_group = guard.idle
        self.upgrading = False
        self._running: Any = None  # the request being answered; `cycle` is the last request
        self._fault: Problem | None = None  # why a callback has stopped the parser
        self._body_lingers = False  # the last reply was sent before the request's end arrived
        self._trailer_bytes = self._chunks = 0
        self._part_bytes = self._part_requests = 0  # bytes and requests in the latest part
        # Bytes since the last complete request, including the part in which that request ended.
        self._unread_bytes = 0
        self._known_bytes = 0  # the share of `_unread_bytes` up to the latest part with body bytes

    @property
    def lingers(self) -> bool:
        """Whether the last reply was sent and the client has not closed the connection yet."""
        return self._phase is Phase.CLOSING and not self.transport.is_closing()

    def begin_draining(self) -> None:
        """Close the connection after the reply to the request in progress, if there is one."""
        if self.cycle is not None and not self.cycle.response_complete:
            self.close_after_reply()

    def drain(self, elapsed_s: float) -> bool:
        """Close the connection after 1 s (DRAIN_S) without a request, counted from the start of
        draining, `elapsed_s` ago. Returns whether all replies to its client have been sent."""
        idle = self._phase is Phase.IDLE or (self._phase is Phase.HEAD and not self._unread_bytes)
        # Answers sent before draining began had no "Connection: close", so the client can send
        # one more request.
        if idle and min(elapsed_s, self.guard.clock() - self.since_s) >= guards.DRAIN_S:
            self.linger()
        return self._phase is Phase.CLOSING and not (self._body_lingers and self.lingers)

    def end_draining(self) -> None:
        """Refuse an incomplete or unanswered request, and close the connection."""
        if self._phase is not Phase.CLOSING:
            self.close_with(stopping())

    def leave(self) -> None:
        """Stop managing this connection, because a WebSocket takes it over."""
        self.connections.discard(self)
        self._phase, self._deadline_s = Phase.CLOSING, inf
        self.group.pop(self, None)

    def close_after_reply(self) -> None:
        """Close the connection after the reply to the latest received request."""
        self.cycle.keep_alive = False
        if isinstance(self.cycle, RequestResponseCycle):
            self.cycle.transport = LingeringTransport(self)  # type: ignore[assignment]

    def end(self) -> None:
        """Close after the last reply; if the client can still be sending, read until it closes."""
        lingers = self.guard.draining or self._phase is Phase.BODY
        (self.linger if lingers else self.transport.close)()

    def linger(self) -> None:
        """Send no more, but read until the client closes the connection.

        Closing a connection with unread bytes resets it, and the client loses the reply.
        """
        self._body_lingers = self._phase is Phase.BODY  # the client can still send all of the body
        self._phase = Phase.CLOSING
        self.pipeline.clear()  # "Connection: close" implies that these requests get no answer
        now = self.guard.place(self, self.guard.refused)
        unsent = self.transport.get_write_buffer_size()
        limits = self.guard.limits
        linger_s = limits.body_s if self._body_lingers else guards.LINGER_S
        self._deadline_s = now + (limits.idle_s if unsent else linger_s)
        if not self.transport.is_closing():
            self.transport.write_eof()

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        super().connection_made(transport)
        self.client = self.guard.admit(self, self.client)
        self._settle()
        guard, limit = self.guard, self.guard.limits.connections
        count = len(self.connections) - len(guard.closing) + guard.other_connections()
        if count > limit and not guard.make_room_for(self, count - limit):
            detail = f"{limit} connections are open; use one connection for all requests"
            self.close_with(Problem(TOO_MANY_CONNECTIONS, detail))

    def data_received(self, data: bytes) -> None:
        phase = self._phase
        if phase is Phase.CLOSING:
            return
        if phase is Phase.IDLE:
            self._unread_bytes = self._known_bytes = 0
            self._phase = Phase.HEAD
        self.guard.reading = self
        self._part_bytes, self._part_requests = len(data), 0
        self._unread_bytes += self._part_bytes
        upgrade_at = None
        try:
            upgrade_at = self.feed(data)
            if upgrade_at is not None:
                parse_upgrades(self, data[upgrade_at:])
        except HttpParserError:
            if self._phase is not Phase.CLOSING:
                self.send_400_response("")
        # Incomplete headers and trailers are counted as they arrive.
        excess = self._unread_bytes - self._known_bytes > MAX_HEAD_BYTES
        if excess and self._phase is not Phase.CLOSING:
            self.close_with(head_too_large())
        if self._settled is not self._phase:
            self._settle()
        if upgrade_at is None:  # otherwise the WebSocket decides when to read
            self.guard.pause_after(self, len(data))

    def feed(self, data: bytes) -> int | None:
        """Parse `data`. Returns the offset after the headers of a request with an upgrade, or None
        if `data` has no request with an upgrade."""
        try:
            self.parser.feed_data(data)
        except HttpParserUpgrade as upgrade:
            return int(upgrade.args[0])
        return None

    def drop_trailer(self, name: bytes, value: bytes) -> None:
        """Count a trailer. Stops the parser with ValueError if the trailers are too large."""
        self._trailer_bytes += len(name) + len(value)
        if self._trailer_bytes > MAX_HEAD_BYTES:
            self.stop_parser(head_too_large())

    def begin_body(self) -> None:
        """Begin the body phase. Stops the parser with ValueError if the headers are too large."""
        if self._unread_bytes > MAX_HEAD_BYTES:
            self._check_head_size()
        self._trailer_bytes = self._chunks = 0
        self._phase = Phase.BODY

    def begin_upgrade(self) -> None:
        """Mark the request for `parse_upgrades`, which handles it after the parser has returned."""
        self._check_head_size()
        self.upgrading = True

    def on_headers_complete(self) -> None:
        self.begin_body()
        if len(self.pipeline) >= MAX_PIPELINED:
            self.stop_parser(too_many_requests(f"{MAX_PIPELINED} requests"))
        super().on_headers_complete()
        if self.cycle is not None and (self.guard.draining or not self.cycle.keep_alive):
            self.close_after_reply()

    def on_chunk_header(self) -> None:
        """Count a chunk of a body. Stops the parser with ValueError if there are too many."""
        self._chunks += 1
        if self._chunks > FREE_CHUNKS + self._unread_bytes // CHUNK_BYTES:
            self.stop_parser(small_chunks(CHUNK_BYTES))

    def on_body(self, body: bytes) -> None:
        self._known_bytes = self._unread_bytes
        super().on_body(body)

    def on_body_complete(self) -> None:
        """Begin the work phase, or the idle phase if the answer was already sent."""
        if self._phase is Phase.CLOSING:
            self._body_lingers = False
            self._deadline_s = min(self._deadline_s, self.guard.clock() + guards.LINGER_S)
            return
        self._unread_bytes = self._known_bytes = self._part_bytes
        waits = not (self.cycle is None or self.cycle.response_complete)
        self._phase = Phase.WORK if waits else Phase.IDLE

    def on_message_complete(self) -> None:
        if self.upgrading:  # `parse_upgrades` follows
            return
        self.on_body_complete()
        super().on_message_complete()

    def on_response_complete(self) -> None:
        if self.pipeline:
            super().on_response_complete()
            return
        self.server_state.total_requests += 1
        self.flow.resume_reading()
        if self._phase is Phase.WORK:
            self._phase = Phase.IDLE
            self._settle()

    def pause_writing(self) -> None:
        super().pause_writing()
        # The client has `idle_s` to read the reply; a refused connection has an earlier deadline.
        self._deadline_s = min(self._deadline_s, self.guard.clock() + self.guard.limits.idle_s)

    def resume_writing(self) -> None:
        super().resume_writing()
        if self._phase is Phase.WORK:
            self._deadline_s = self.guard.clock() + WORK_S

    def connection_lost(self, exc: Exception | None) -> None:
        self._phase, self._deadline_s = Phase.CLOSING, inf
        self.guard.forget(self)
        self.abandon_requests()
        super().connection_lost(exc)
        self.pipeline.clear()  # its requests reference this connection
        self.cycle = self._running = None  # type: ignore[assignment]

    def abandon_requests(self) -> None:
        """Mark the unfinished requests as disconnected, since no client waits for them."""
        for cycle in (self._running, self.cycle):
            if cycle is not None and not cycle.response_complete:
                cycle.disconnected = True
                cycle.waiting_for_100_continue = False  # no interim reply after the refusal
                cycle.message_event.set()

    def _start_asgi_task(self, cycle: RequestResponseCycle, app: Any) -> None:
        self._running = cycle
        super()._start_asgi_task(cycle, app)

    def _settle(self) -> None:
        """Move to the group of the current phase, and set the phase's deadline."""
        guard, limits, phase = self.guard, self.guard.limits, self._phase
        self._settled = phase
        if phase is Phase.IDLE:
            self._deadline_s = guard.place(self, self._idle_group) + limits.idle_s
        elif phase is Phase.WORK:
            end_s = guard.place(self, guard.working) + WORK_S
            # A client that does not read its replies gets no more time by further requests.
            self._deadline_s = min(end_s, self._deadline_s) if self.flow.write_paused else end_s
        elif phase is Phase.BODY:
            self._deadline_s = guard.place(self, guard.receiving) + limits.body_s
        elif phase is Phase.HEAD:
            self._deadline_s = guard.place(self, guard.receiving) + limits.head_s

    def _check_head_size(self) -> None:
        size = len(self.url) + sum(len(k) + len(v) for k, v in self.headers)
        if size > MAX_HEAD_BYTES:
            self.stop_parser(head_too_large())

    def stop_parser(self, fault: Problem) -> None:
        """Stop the parser with ValueError; the request ends with the problem `fault`."""
        self._fault = fault
        raise ValueError(fault.detail)  # httptools' error leads to `send_400_response`

    def send_400_response(self, msg: str) -> None:
        detail = "the bytes received are not an HTTP/1.1 request"
        self.close_with(self._fault or Problem(MALFORMED, detail))

    def give_way(self) -> None:
        """Make room for a new connection: close if idle (after the unsent bytes), else abort."""
        idle = self._phase is Phase.IDLE
        self._phase, self._deadline_s = Phase.CLOSING, self.guard.clock() + guards.LINGER_S
        (self.transport.close if idle else self.transport.abort)()

    def end_slow_body(self, now: float) -> int:
        """Close if a body has been arriving for 0.1 s (EVICTABLE_S); return its freed bytes."""
        if self._phase is not Phase.BODY or now - self.since_s < guards.EVICTABLE_S:
            return 0
        held = 0 if self.cycle is None or self.cycle.response_complete else self._unread_bytes
        self.close_with(Problem(OVERLOADED, "the bodies in flight need too much memory"))
        return held

    def expire(self, now: float) -> None:
        """Close the connection if its deadline is before `now` (in s of the guard's clock)."""
        if now < self._deadline_s:
            return
        phase, limits = self._phase, self.guard.limits
        if phase is Phase.HEAD and self._unread_bytes:
            self.close_with(too_slow("headers", limits.head_s))
        elif phase is Phase.BODY:
            self.close_with(too_slow("body", limits.body_s))
        else:
            self._phase, self._deadline_s = Phase.CLOSING, inf
            self.guard.place(self, self.guard.closing)
            # `close` would wait for a client that does not read its answer.
            idle = phase is Phase.IDLE and not self.transport.get_write_buffer_size()
            (self.transport.close if idle else self.transport.abort)()

    def close_with(self, problem: Problem) -> None:
        """Send a problem and close the connection. If an earlier request still waits for its reply,
        this reply is sent instead of the problem."""
        owed = self._running if self.pipeline or self._phase is Phase.WORK else None
        self._phase = Phase.CLOSING
        now = self.guard.place(self, self.guard.refused)
        self._deadline_s = now + guards.LINGER_S
        self.guard.count_closed(problem.type)
        if owed is not None:  # the client would take the problem for this reply
            self.pipeline.clear()
            self.cycle = owed
            owed.keep_alive = False
            self._deadline_s = now + WORK_S
            return
        self.abandon_requests()
        if self.transport.is_closing():
            return
        url = getattr(self, "url", b"").decode("latin-1")  # unset before the first request
        reply = problem_reply(problem, (b"connection", b"close"), path=url)
        self.transport.write(encode_head(reply) + reply.body)
        self.transport.write_eof()  # an abort would lose the reply of a client still sending
