"""OpenTelemetry spans: a request for features has a span, which contains the span of its frame,
which contains the spans of the frame's stages.

A request continues the trace of its `traceparent` header (W3C Trace Context); a frame of a
WebSocket continues the trace of the handshake. Probes, pages, requests refused before they are read
(rate, token) and requests of clients that disconnect have no span. Attributes follow the semantic
conventions for HTTP; additional ones start with `driverview.`. This module is imported only if
traces are enabled (`serve.observability.telemetry`).
"""

import time
from collections.abc import Awaitable, Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import Any

from opentelemetry import context, propagate, trace
from opentelemetry.trace import Span, SpanKind, Status, StatusCode, Tracer

from mtlnet.inference.image_decoding.errors import ImageError
from serve.api.features import FeaturesRequest, FrameHandler, client_address
from serve.api.http_io import Message, Receive, Reply, Scope, Send
from serve.api.kserve import MODELS
from serve.api.problems import Problem
from serve.api.request_options import Headers, RequestOptions
from serve.scheduling.fair_queue import FrameResult

App = Callable[[Scope, Receive, Send], Awaitable[None]]
INFER_PATHS = {f"{model}/infer" for model in MODELS}


class TracedFrameHandler(FrameHandler):
    """A FrameHandler with a span `perceive` for each frame, which contains the spans `queue`,
    `decode` and `forward`."""

    def __init__(self, tracer: Tracer, *arguments: Any) -> None:
        super().__init__(*arguments)
        self._tracer = tracer

    def refuse_early(self, headers: Headers, client: str) -> Reply | None:
        """Returns None, so that `TracedFeaturesRequest` refuses the frame, in a span."""
        return None

    def record_answer(self, options: RequestOptions, client: str, result: FrameResult) -> None:
        super().record_answer(options, client, result)
        start_ns = options.stamp_ns + time.time_ns() - time.monotonic_ns()  # since 1970
        attributes = {"driverview.request_id": options.request_id, "client.address": client}
        attributes |= {f"driverview.{name}": value for name, value in result.provenance.items()}
        if options.frame_id is not None:
            attributes["driverview.frame_id"] = options.frame_id
        span = self._tracer.start_span("perceive", start_time=start_ns, attributes=attributes)
        context_of_span, at = trace.set_span_in_context(span), start_ns
        for name, time_ms in (
            ("queue", result.queue_ms),
            ("decode", result.decode_ms),
            ("forward", result.forward_ms),
        ):
            end = at + round(1e6 * time_ms)
            self._tracer.start_span(name, context_of_span, start_time=at).end(end)
            at = end
        span.end()

    def record_refusal(self, error: Problem | ImageError, request_id: str, client: str) -> Problem:
        problem = super().record_refusal(error, request_id, client)
        span = trace.get_current_span()
        if span.is_recording():
            _set_problem(span, problem, request_id)
        else:  # a frame of a WebSocket has no request span
            with self._tracer.start_as_current_span("refuse") as own:
                _set_problem(own, problem, request_id)
        return problem


class TracedFeaturesRequest(FeaturesRequest):
    """A POST /features with a span from the headers to the reply."""

    __slots__ = ("_context", "_send_reply", "_span", "_tracer")

    def __init__(
        self, tracer: Tracer, frames: FrameHandler, client: str, send: Callable[[Reply], None]
    ) -> None:
        super().__init__(frames, client, self._end)
        self._tracer = tracer
        self._send_reply = send

    def open(self, headers: Headers) -> bool:
        parent = _parent_context(headers.items())
        attributes = _request_attributes("/features", self._client)
        self._span = self._tracer.start_span("POST /features", parent, SpanKind.SERVER, attributes)
        self._context = trace.set_span_in_context(self._span, parent)
        with _attached(self._context):
            return super().open(headers)

    def submit(self, body: bytes) -> None:
        with _attached(self._context):
            super().submit(body)

    def refuse(self, error: Problem | ImageError) -> None:
        with _attached(self._context):
            super().refuse(error)

    def _on_result(self, result: FrameResult | Exception) -> None:
        with _attached(self._context):
            super()._on_result(result)

    def _end(self, reply: Reply) -> None:
        _set_status(self._span, reply.status)
        self._span.end()
        self._send_reply(reply)


class TracedApp:
    """An ASGI application with a span for each inference request (Open Inference Protocol)."""

    def __init__(self, tracer: Tracer, app: App) -> None:
        self._tracer = tracer
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] == "http" and _is_infer_request(scope):
            await self._answer(scope, receive, send)
        elif scope["type"] == "websocket":
            with _attached(_parent_context(scope["headers"])):  # for each frame's task
                await self._app(scope, receive, send)
        else:
            await self._app(scope, receive, send)

    async def _answer(self, scope: Scope, receive: Receive, send: Send) -> None:
        with self._tracer.start_as_current_span(
            f"POST {scope['path']}",
            _parent_context(scope["headers"]),
            SpanKind.SERVER,
            _request_attributes(scope["path"], client_address(scope)),
        ) as span:

            async def send_and_record(message: Message) -> None:
                if message["type"] == "http.response.start":
                    _set_status(span, message["status"])
                await send(message)

            await self._app(scope, receive, send_and_record)


def _is_infer_request(scope: Scope) -> bool:
    path: str = scope["path"]
    return scope["method"] == "POST" and path in INFER_PATHS


def _request_attributes(path: str, client: str) -> dict[str, str]:
    return {"http.request.method": "POST", "url.path": path, "client.address": client}


def _parent_context(headers: Iterable[tuple[bytes, bytes]]) -> context.Context:
    return propagate.extract({k.decode("latin-1"): v.decode("latin-1") for k, v in headers})


@contextmanager
def _attached(to: context.Context) -> Iterator[None]:
    token = context.attach(to)
    try:
        yield
    finally:
        context.detach(token)


def _set_status(span: Span, status: int) -> None:
    span.set_attribute("http.response.status_code", status)
    if status >= 500:
        span.set_status(Status(StatusCode.ERROR))


def _set_problem(span: Span, problem: Problem, request_id: str) -> None:
    span.set_attribute("error.type", problem.type.uri)
    span.set_attribute("driverview.request_id", request_id)
    if problem.type.status >= 500:
        span.set_status(Status(StatusCode.ERROR, problem.detail))
