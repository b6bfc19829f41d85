"""Handles POST /features from parser to reply without ASGI (no scope, no task, no messages).

ASGI would cost more than all other work of a request besides the model. It handles all other
requests, and POST /features with an upgrade, with "Expect: 100-continue", with X-Forwarded-For, or
pipelined before the reply to the previous request.
"""

from functools import partial
from http import HTTPStatus
from typing import Any

from serve.api.features import FeaturesRequest
from serve.api.request_options import Headers
from serve.app import Service
from serve.problems import Problem, too_many_requests
from serve.replies import Header, Reply, encode_head
from serve.server.connection import MAX_AT_ONCE, GuardedProtocol, Phase

CLOSE_HEADER: Header = (b"connection", b"close")
SMALL_BYTES = 1024  # smaller parts of a body are joined: one object for each needs more memory
TOGETHER_BYTES = 1 << 16  # size at which a joined object ends: growing a long object copies it
BODY, CLOSING = Phase.BODY, Phase.CLOSING
OK, UNAVAILABLE = HTTPStatus.OK.value, HTTPStatus.SERVICE_UNAVAILABLE.value
ASGI_HEADERS = frozenset({b"expect", b"upgrade", b"x-forwarded-for"})


class NullEvent:
    """An event that does nothing: uvicorn sets the event of each request, but no task waits for it
    here."""

    def set(self) -> None:
        """Do nothing."""


class DirectRequest:
    """A request POST /features in progress. It has the attributes that uvicorn reads from its
    RequestResponseCycle."""

    __slots__ = (
        "disconnected",
        "features",
        "keep_alive",
        "parts",
        "response_complete",
        "waiting_for_100_continue",
    )
    message_event = NullEvent()

    def __init__(self, keep_alive: bool) -> None:
        self.keep_alive = keep_alive
        self.disconnected = self.response_complete = self.waiting_for_100_continue = False
        self.features: FeaturesRequest | None = None
        self.parts: list[bytes | bytearray] = []

    def add(self, part: bytes) -> None:
        """Append a part of the body, unless the request was refused."""
        if self.features is None:
            return
        try:
            self.features.receive(len(part))
        except Problem as problem:
            self.features.refuse(problem)
            self.drop()
            return
        last = self.parts[-1] if self.parts else None
        if len(part) >= SMALL_BYTES:
            self.parts.append(part)
        elif isinstance(last, bytearray) and len(last) < TOGETHER_BYTES:
            last += part
        else:
            self.parts.append(bytearray(part))

    def drop(self) -> None:
        """Drop the body and `features`. This object and `features` reference each other; without a
        call of `drop`, both would stay in memory until the next garbage collection."""
        if self.features is not None:
            self.features.abandon()
        self.features = None
        self.parts.clear()

    def submit(self) -> None:
        """Submit the complete body, unless the request was refused."""
        parts, self.parts = self.parts, []
        if self.features is not None:
            self.features.submit(bytes(parts[0]) if len(parts) == 1 else b"".join(parts))


class DirectProtocol(GuardedProtocol):
    """One HTTP connection to `service`; it handles POST /features itself."""

    def __init__(self, *arguments: Any, service: Service, **named: Any) -> None:
        super().__init__(*arguments, **named)
        self._service = service
        self._request: DirectRequest | None = None

    def on_message_begin(self) -> None:
        if self._phase is CLOSING:  # the last reply was sent while this part was parsed
            raise ValueError
        self._part_requests += 1
        if self._part_requests > MAX_AT_ONCE:
            self.stop_parser(too_many_requests(f"{MAX_AT_ONCE} requests"))
        self._settled = None
        self.url = b""
        self.headers = []

    def on_header(self, name: bytes, value: bytes) -> None:
        if self._phase is BODY:
            self.drop_trailer(name, value)
        else:
            self.headers.append((name.lower(), value))

    def on_headers_complete(self) -> None:
        if self.parser.should_upgrade():
            self.begin_upgrade()
            return
        headers = dict(self.headers)
        if not self._bypasses_asgi(headers):
            self._build_scope()
            super().on_headers_complete()
            return
        self.begin_body()
        self.cycle: Any = DirectRequest(not self.guard.draining and self.parser.should_keep_alive())
        self._request = self._running = request = self.cycle
        service, client = self._service, self.client[0] if self.client else ""
        send = partial(self._reply, request)
        refusal = service.access.refusal(headers, client)
        if refusal is not None:
            send(refusal)
            return
        features = service.make_request(client, send)
        if features.open(headers):
            request.features = features

    def on_body(self, body: bytes) -> None:
        if self._request is None:
            super().on_body(body)
        else:
            self._known_bytes = self._unread_bytes
            self._request.add(body)

    def on_message_complete(self) -> None:
        request, self._request = self._request, None
        if request is None:
            super().on_message_complete()
            return
        self.on_body_complete()
        request.submit()

    def abandon_requests(self) -> None:
        request, self._request = self._request, None
        if request is not None:
            request.drop()
        super().abandon_requests()

    def resume_writing(self) -> None:
        super().resume_writing()
        self.flow.resume_reading()

    def _bypasses_asgi(self, headers: Headers) -> bool:
        return (
            self.url == b"/features"
            and self.parser.get_method() == b"POST"
            and (self.cycle is None or self.cycle.response_complete)
            and self.parser.get_http_version() == "1.1"
            and headers.keys().isdisjoint(ASGI_HEADERS)
            and len(headers) == len(self.headers)  # no name occurs twice
        )

    def _build_scope(self) -> None:
        """Build the ASGI scope that uvicorn builds while it parses a request."""
        url, headers = self.url, self.headers
        super().on_message_begin()
        self.url = url
        for name, value in headers:
            super().on_header(name, value)

    def _reply(self, request: DirectRequest, reply: Reply) -> None:
        request.response_complete = True
        request.features = None  # breaks a reference cycle
        if request.disconnected or self.transport.is_closing():
            return
        headers = self.server_state.default_headers
        if not request.keep_alive:
            headers = [*headers, CLOSE_HEADER]
        self.transport.write(encode_head(reply, *headers) + reply.body)
        if not request.keep_alive:
            self.end()
        if reply.status == OK:
            self._idle_group = self.guard.served
        self.on_response_complete()
        if self.flow.write_paused:  # read no more requests of a client that reads no replies
            self.flow.pause_reading()
        elif reply.status == UNAVAILABLE and self._service.frame_queue.is_thread_behind:
            self.guard.pause_reading(self)
