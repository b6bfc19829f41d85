"""What is traced: a span a request for features, in it one for its frame, in that its stages. A
request's trace goes on from its `traceparent` (W3C Trace Context), a frame's of a WebSocket from
that of the handshake. Probes, pages and what the door refuses have no span; nor has a request whose
client departs before its body is whole.

Loaded only where telemetry is on (`serve.observability.telemetry`): the hot path knows nothing of
it. Names after OpenTelemetry's semantic conventions for HTTP, our own under `driverview.`.
"""

import time
from collections.abc import Awaitable, Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import Any

from opentelemetry import context, propagate, trace
from opentelemetry.trace import Span, SpanKind, Status, StatusCode, Tracer

from mtlnet.inference.image_decoding.errors import ImageError
from serve.api.features import FeaturesRequest, FrameHandler, client_of
from serve.api.http_io import Message, Receive, Reply, Scope, Send
from serve.api.kserve import MODELS
from serve.api.problems import Problem
from serve.api.request_options import Headers, RequestOptions
from serve.scheduling.frame_queue import Perceived

App = Callable[[Scope, Receive, Send], Awaitable[None]]
INFERENCE = {f"{model}/infer" for model in MODELS}


class TracedSight(FrameHandler):
    """`FrameHandler`, with a span a frame: `perceive`, and in it `queue`, `decode` and
    `forward`."""

    def __init__(self, tracer: Tracer, *arguments: Any) -> None:
        super().__init__(*arguments)
        self._tracer = tracer

    def answered(self, ask: RequestOptions, client: str, perceived: Perceived) -> None:
        super().answered(ask, client, perceived)
        begin = ask.stamp_ns + time.time_ns() - time.monotonic_ns()  # since 1970, ns
        about = {"driverview.request_id": ask.request_id, "client.address": client}
        about |= {f"driverview.{name}": value for name, value in perceived.origin.items()}
        if ask.frame_id is not None:
            about["driverview.frame_id"] = ask.frame_id
        span = self._tracer.start_span("perceive", start_time=begin, attributes=about)
        inside, at = trace.set_span_in_context(span), begin
        for name, spent_ms in (
            ("queue", perceived.queue_ms),
            ("decode", perceived.decode_ms),
            ("forward", perceived.forward_ms),
        ):
            end = at + round(1e6 * spent_ms)
            self._tracer.start_span(name, inside, start_time=at).end(end)
            at = end
        span.end()

    def refused(self, error: Problem | ImageError, request: str, client: str) -> Problem:
        problem = super().refused(error, request, client)
        span = trace.get_current_span()
        if span.is_recording():
            _blame(span, problem, request)
        else:  # a frame of a WebSocket, which has no span around it
            with self._tracer.start_as_current_span("refuse") as own:
                _blame(own, problem, request)
        return problem


class TracedExchange(FeaturesRequest):
    """POST /features, with a span from its headers to its reply."""

    __slots__ = ("_context", "_reply_to", "_span", "_tracer")

    def __init__(
        self, tracer: Tracer, sight: FrameHandler, client: str, send: Callable[[Reply], None]
    ) -> None:
        super().__init__(sight, client, self._end)
        self._tracer = tracer
        self._reply_to = send

    def open(self, headers: Headers) -> bool:
        found = _context_of(headers.items())
        about = _about("/features", self._client)
        self._span = self._tracer.start_span("POST /features", found, SpanKind.SERVER, about)
        self._context = trace.set_span_in_context(self._span, found)
        with _within(self._context):
            return super().open(headers)

    def take(self, body: bytes) -> None:
        with _within(self._context):
            super().take(body)

    def refuse(self, error: Problem | ImageError) -> None:
        with _within(self._context):
            super().refuse(error)

    def _answer(self, result: Perceived | Exception) -> None:
        with _within(self._context):
            super()._answer(result)

    def _end(self, reply: Reply) -> None:
        _tell_status(self._span, reply.status)
        self._span.end()
        self._reply_to(reply)


class Traced:
    """An ASGI application beside POST /features, with a span around each request for features."""

    def __init__(self, tracer: Tracer, app: App) -> None:
        self._tracer = tracer
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] == "http" and _is_inference(scope):
            await self._answer(scope, receive, send)
        elif scope["type"] == "websocket":
            with _within(_context_of(scope["headers"])):  # each frame's task inherits it
                await self._app(scope, receive, send)
        else:
            await self._app(scope, receive, send)

    async def _answer(self, scope: Scope, receive: Receive, send: Send) -> None:
        with self._tracer.start_as_current_span(
            f"POST {scope['path']}",
            _context_of(scope["headers"]),
            SpanKind.SERVER,
            _about(scope["path"], client_of(scope)),
        ) as span:

            async def send_and_tell(message: Message) -> None:
                if message["type"] == "http.response.start":
                    _tell_status(span, message["status"])
                await send(message)

            await self._app(scope, receive, send_and_tell)


def _is_inference(scope: Scope) -> bool:
    path: str = scope["path"]
    return scope["method"] == "POST" and path in INFERENCE


def _about(path: str, client: str) -> dict[str, str]:
    return {"http.request.method": "POST", "url.path": path, "client.address": client}


def _context_of(headers: Iterable[tuple[bytes, bytes]]) -> context.Context:
    return propagate.extract({k.decode("latin-1"): v.decode("latin-1") for k, v in headers})


@contextmanager
def _within(found: context.Context) -> Iterator[None]:
    token = context.attach(found)
    try:
        yield
    finally:
        context.detach(token)


def _tell_status(span: Span, status: int) -> None:
    span.set_attribute("http.response.status_code", status)
    if status >= 500:
        span.set_status(Status(StatusCode.ERROR))


def _blame(span: Span, problem: Problem, request: str) -> None:
    span.set_attribute("error.type", problem.kind.type)
    span.set_attribute("driverview.request_id", request)
    if problem.kind.status >= 500:
        span.set_status(Status(StatusCode.ERROR, problem.detail))
