"""POST /features straight from the parser to its reply: no scope, no task, no messages between.

What stands in the way of ASGI costs more than all else that a request needs beside the model. All
other requests take that way, and so do the few for this path that need more of it: an upgrade, a
client that waits for "100 Continue", a proxy's word about its client, one request before the reply
to the last.
"""

from functools import partial
from typing import Any

from serve.api.features import FeaturesRequest
from serve.api.http_io import Header, Reply, check_size, head_of
from serve.api.problems import Problem
from serve.api.request_options import Headers
from serve.app import Service
from serve.server.connection import GuardedProtocol, Phase

CLOSE: Header = (b"connection", b"close")
INDIRECT = frozenset({b"expect", b"upgrade", b"x-forwarded-for"})


class Nobody:
    """An event that nobody waits for."""

    def set(self) -> None:
        pass


class Direct:
    """A request on its way; where uvicorn looks at it, it looks like one of its cycles."""

    __slots__ = ("disconnected", "exchange", "keep_alive", "parts", "response_complete", "size")
    message_event = Nobody()

    def __init__(self, keep_alive: bool) -> None:
        self.keep_alive = keep_alive
        self.disconnected = self.response_complete = False
        self.exchange: FeaturesRequest | None = None
        self.parts: list[bytes] = []
        self.size = 0

    def add(self, part: bytes) -> None:
        """Take some of the body, unless the request was refused."""
        if self.exchange is None:
            return
        self.parts.append(part)
        self.size += len(part)
        try:
            check_size(self.size)
        except Problem as problem:
            self.exchange.refuse(problem)
            self.exchange = None

    @property
    def body(self) -> bytes:
        """What has come."""
        return self.parts[0] if len(self.parts) == 1 else b"".join(self.parts)


class DirectProtocol(GuardedProtocol):
    """One HTTP connection to `service`."""

    def __init__(self, *arguments: Any, service: Service, **named: Any) -> None:
        super().__init__(*arguments, **named)
        self._service = service
        self._direct: Direct | None = None

    def on_message_begin(self) -> None:
        self.url = b""
        self.headers = []

    def on_header(self, name: bytes, value: bytes) -> None:
        self.headers.append((name.lower(), value))

    def on_headers_complete(self) -> None:
        headers = dict(self.headers)
        if not self._goes_directly(headers):
            self._build_scope()
            super().on_headers_complete()
            return
        self.check_head()
        self.cycle: Any = Direct(not self._guard.draining and self.parser.should_keep_alive())
        self._direct = direct = self.cycle
        send = partial(self._reply, direct)
        direct.exchange = self._service.open(headers, self.client[0] if self.client else "", send)

    def on_body(self, body: bytes) -> None:
        if self._direct is None:
            super().on_body(body)
        else:
            self._direct.add(body)

    def on_message_complete(self) -> None:
        direct, self._direct = self._direct, None
        if direct is None:
            super().on_message_complete()
            return
        self.body_is_whole()
        if direct.exchange is not None:
            direct.exchange.take(direct.body)

    def resume_writing(self) -> None:
        super().resume_writing()
        self.flow.resume_reading()

    def _goes_directly(self, headers: Headers) -> bool:
        return (
            self.url == b"/features"
            and self.parser.get_method() == b"POST"
            and (self.cycle is None or self.cycle.response_complete)
            and self.parser.get_http_version() == "1.1"
            and headers.keys().isdisjoint(INDIRECT)
        )

    def _build_scope(self) -> None:
        """What uvicorn does as it reads a request, done when that request is to be its own."""
        url, headers = self.url, self.headers
        super().on_message_begin()
        self.url = url
        for name, value in headers:
            super().on_header(name, value)

    def _reply(self, direct: Direct, whole: Reply) -> None:
        direct.response_complete = True
        direct.exchange = None  # which holds it in turn, by its way to reply
        if direct.disconnected or self.transport.is_closing() or self._phase is Phase.DISMISSED:
            return
        more = self.server_state.default_headers
        if not direct.keep_alive:
            more = [*more, CLOSE]
        self.transport.write(head_of(whole, *more) + whole.body)
        if not direct.keep_alive:
            self.transport.close()
        self.on_response_complete()
        if self.flow.write_paused:  # whoever does not read is not listened to
            self.flow.pause_reading()
