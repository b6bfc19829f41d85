"""Records OpenTelemetry spans: the span of a request for features contains the span of its frame,
which contains the spans of the frame's stages (waiting, decoding, forward pass).

A request continues the trace of its `traceparent` header (W3C Trace Context); a frame of a
WebSocket continues the trace of the handshake. Probes, pages, requests refused before they are read
(rate, token) and requests of clients that disconnect have no span. Attributes follow the semantic
conventions for HTTP; additional attributes start with `driverview.`. This module is imported only
if traces are enabled (`serve.observability.telemetry`).
"""

import time
from collections.abc import Collection, Iterable

from opentelemetry import context, propagate, trace
from opentelemetry.trace import Span, SpanKind, Status, StatusCode, Tracer

from serve.asgi import App, Message, Receive, Scope, Send, client_address
from serve.problems import Problem
from serve.scheduling.frame import FrameResult


class RequestTracer:
    """Records the spans of requests and frames. A `span` of None stands for the current span."""

    def __init__(self, tracer: Tracer) -> None:
        self._tracer = tracer

    def begin(self, path: str, headers: Iterable[tuple[bytes, bytes]], client: str) -> Span:
        """Begin the span of a POST request."""
        attributes = {"http.request.method": "POST", "url.path": path, "client.address": client}
        parent = _parent_context(headers)
        return self._tracer.start_span(f"POST {path}", parent, SpanKind.SERVER, attributes)

    def end(self, span: Span, status: int) -> None:
        """End the span of a request that was answered with this HTTP status."""
        _set_status(span, status)
        span.end()

    def record_answer(
        self,
        span: Span | None,
        stamp_ns: int,
        request_id: str,
        frame_id: str | None,
        client: str,
        result: FrameResult,
    ) -> None:
        """Record the span `perceive` of a frame, which contains `queue`, `decode` and `forward`.

        `stamp_ns` is the start of its request on the monotonic clock.
        """
        start_ns = stamp_ns + time.time_ns() - time.monotonic_ns()  # since 1970
        attributes = {"driverview.request_id": request_id, "client.address": client}
        attributes |= {f"driverview.{name}": value for name, value in result.provenance.items()}
        if frame_id is not None:
            attributes["driverview.frame_id"] = frame_id
        parent = None if span is None else trace.set_span_in_context(span)
        frame = self._tracer.start_span(
            "perceive", parent, start_time=start_ns, attributes=attributes
        )
        context_of_frame, at = trace.set_span_in_context(frame), start_ns
        for name, time_ms in (
            ("queue", result.queue_ms),
            ("decode", result.decode_ms),
            ("forward", result.forward_ms),
        ):
            end = at + round(1e6 * time_ms)
            self._tracer.start_span(name, context_of_frame, start_time=at).end(end)
            at = end
        frame.end()

    def record_problem(self, span: Span | None, problem: Problem, request_id: str) -> None:
        """Record why a request was refused: in its span, or in a new span `refuse` if there is
        none."""
        found = trace.get_current_span() if span is None else span
        if found.is_recording():
            _set_problem(found, problem, request_id)
        else:  # a frame of a WebSocket has no request span
            with self._tracer.start_as_current_span("refuse") as own:
                _set_problem(own, problem, request_id)

    def traced(self, app: App, paths: Collection[str]) -> App:
        """Wrap `app` so that each POST to one of `paths` has a span. The spans of a WebSocket's
        frames continue the trace of its handshake."""

        async def call(scope: Scope, receive: Receive, send: Send) -> None:
            if scope["type"] == "websocket":
                token = context.attach(_parent_context(scope["headers"]))  # for each frame's task
                try:
                    await app(scope, receive, send)
                finally:
                    context.detach(token)
                return
            if scope["type"] != "http" or scope["method"] != "POST" or scope["path"] not in paths:
                await app(scope, receive, send)
                return
            started = self.begin(scope["path"], scope["headers"], client_address(scope))
            with trace.use_span(started, end_on_exit=True) as span:

                async def send_and_record(message: Message) -> None:
                    if message["type"] == "http.response.start":
                        _set_status(span, message["status"])
                    await send(message)

                await app(scope, receive, send_and_record)

        return call


def _parent_context(headers: Iterable[tuple[bytes, bytes]]) -> context.Context:
    return propagate.extract({k.decode("latin-1"): v.decode("latin-1") for k, v in headers})


def _set_status(span: Span, status: int) -> None:
    span.set_attribute("http.response.status_code", status)
    if status >= 500:
        span.set_status(Status(StatusCode.ERROR))


def _set_problem(span: Span, problem: Problem, request_id: str) -> None:
    span.set_attribute("error.type", problem.type.uri)
    span.set_attribute("driverview.request_id", request_id)
    if problem.type.status >= 500:
        span.set_status(Status(StatusCode.ERROR, problem.detail))
