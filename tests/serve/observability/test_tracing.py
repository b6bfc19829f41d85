"""Traces: names and parents of the spans, their export to a collector."""

import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, HTTPServer
from typing import Any

import pytest
from opentelemetry.proto.collector.trace.v1.trace_service_pb2 import ExportTraceServiceRequest
from opentelemetry.sdk.trace import ReadableSpan, TracerProvider
from opentelemetry.sdk.trace.export import SimpleSpanProcessor
from opentelemetry.sdk.trace.export.in_memory_span_exporter import InMemorySpanExporter
from opentelemetry.trace import SpanKind, StatusCode

from serve.observability import telemetry
from tests.serve.api.test_kserve import BASE64, infer
from tests.serve.api.test_stream import dial, read
from tests.serve.conftest import JPEG, FakeEngine, Served, serving, until
from trackfeatures.errors import UserError

TRACE, PARENT = "0af7651916cd43dd8448eb211c80319c", "b7ad6b7169203331"
TRACEPARENT = f"00-{TRACE}-{PARENT}-01"
STAGES = ["queue", "decode", "forward"]


@pytest.fixture
def exporter() -> InMemorySpanExporter:
    return InMemorySpanExporter()


@pytest.fixture
def traced(engine: FakeEngine, exporter: InMemorySpanExporter) -> Iterator[Served]:
    provider = TracerProvider()
    provider.add_span_processor(SimpleSpanProcessor(exporter))
    with serving(engine, tracer=provider.get_tracer("test")) as service:
        yield service


def spans(exporter: InMemorySpanExporter, last: str) -> dict[str, ReadableSpan]:
    """Wait until the span `last` has ended; returns the finished spans by name."""
    until(lambda: last in {span.name for span in exporter.get_finished_spans()})
    return {span.name: span for span in exporter.get_finished_spans()}


def about(span: ReadableSpan) -> dict[str, Any]:
    return dict(span.attributes or {})


def assert_child(child: ReadableSpan, parent: ReadableSpan) -> None:
    assert child.parent is not None
    assert child.parent.span_id == parent.context.span_id
    assert child.context.trace_id == parent.context.trace_id
    assert parent.start_time is not None
    assert child.start_time is not None
    assert child.end_time is not None
    assert child.start_time <= child.end_time


@pytest.mark.parametrize("way", [{}, {"X_Forwarded_For": "127.0.0.1"}], ids=["direct", "asgi"])
def test_a_request_continues_the_callers_trace(
    traced: Served, exporter: InMemorySpanExporter, way: dict[str, str]
) -> None:
    headers = {"X_Request_Id": "r1", "X_Frame_Id": "f1", **way}
    reply = traced.post(JPEG, traceparent=TRACEPARENT, **headers)
    found = spans(exporter, "POST /features")
    assert set(found) == {"POST /features", "perceive", *STAGES}
    root, frame = found["POST /features"], found["perceive"]
    assert root.kind is SpanKind.SERVER
    assert root.parent is not None
    assert f"{root.parent.trace_id:032x}-{root.parent.span_id:016x}" == f"{TRACE}-{PARENT}"
    assert about(root)["http.response.status_code"] == 200
    assert about(root)["client.address"] == "127.0.0.1"
    assert_child(frame, root)
    assert about(frame)["driverview.request_id"] == "r1"
    assert about(frame)["driverview.frame_id"] == "f1"
    assert about(frame)["driverview.model"] == reply.content["model"]
    timing = reply.content["timing_ms"]
    at = frame.start_time
    for name in STAGES:
        assert_child(found[name], frame)
        assert found[name].start_time == at  # the stages follow each other
        at = found[name].end_time
        assert (found[name].end_time or 0) - (found[name].start_time or 0) == pytest.approx(
            1e6 * timing[name], abs=1001
        )


def test_tensor_requests_and_websocket_frames_are_traced(
    traced: Served, exporter: InMemorySpanExporter
) -> None:
    assert infer(traced, {"inputs": [BASE64]}, traceparent=TRACEPARENT).status == 200
    found = spans(exporter, "POST /v2/models/track/infer")
    assert_child(found["perceive"], found["POST /v2/models/track/infer"])
    exporter.clear()
    with dial(traced, additional_headers={"traceparent": TRACEPARENT}) as socket:
        socket.send(JPEG)
        read(socket)
        socket.send(b"no image")
        read(socket)
    found = spans(exporter, "refuse")
    assert set(found) == {"perceive", "refuse", *STAGES}
    for name in ("perceive", "refuse"):
        parent = found[name].parent
        assert parent is not None
        assert f"{parent.trace_id:032x}-{parent.span_id:016x}" == f"{TRACE}-{PARENT}"
    assert about(found["refuse"])["error.type"] == "/problems/not-an-image"


def test_refused_requests_record_the_reason_and_probes_have_no_span(
    traced: Served, exporter: InMemorySpanExporter
) -> None:
    for path in ("/readyz", "/metrics", "/model"):
        assert traced.ask("GET", path).status == 200
    assert traced.post(b"no image", X_Request_Id="r2").status == 422
    found = spans(exporter, "POST /features")
    assert set(found) == {"POST /features"}
    root = found["POST /features"]
    assert root.parent is None
    assert about(root)["error.type"] == "/problems/not-an-image"
    assert about(root)["http.response.status_code"] == 422
    assert root.status.status_code is StatusCode.UNSET  # a fault of the client is no error
    exporter.clear()
    assert traced.post(JPEG, X_Deadline_Ms="0").status == 503
    found = spans(exporter, "POST /features")
    assert about(found["POST /features"])["error.type"] == "/problems/deadline-passed"
    assert found["POST /features"].status.status_code is StatusCode.ERROR
    assert set(found) == {"POST /features"}


@contextmanager
def collector() -> Iterator[tuple[str, list[ExportTraceServiceRequest]]]:
    """An OTLP collector over HTTP; yields its address and the list of received requests."""
    received: list[ExportTraceServiceRequest] = []

    class Handler(BaseHTTPRequestHandler):
        def do_POST(self) -> None:
            body = self.rfile.read(int(self.headers["Content-Length"]))
            assert self.path == "/v1/traces"
            received.append(ExportTraceServiceRequest.FromString(body))
            self.send_response(200)
            self.end_headers()

        def log_message(self, *_arguments: Any) -> None:
            pass

    server = HTTPServer(("127.0.0.1", 0), Handler)
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    try:
        yield f"http://127.0.0.1:{server.server_port}", received
    finally:
        server.shutdown()
        thread.join()
        server.server_close()


def test_spans_are_exported_to_the_collector_of_the_standard_variables(
    engine: FakeEngine, monkeypatch: pytest.MonkeyPatch
) -> None:
    with collector() as (address, received):
        monkeypatch.setenv("OTEL_EXPORTER_OTLP_ENDPOINT", address)
        monkeypatch.setenv("OTEL_EXPORTER_OTLP_COMPRESSION", "none")
        monkeypatch.setenv("OTEL_BSP_SCHEDULE_DELAY", "50")
        monkeypatch.setenv("OTEL_RESOURCE_ATTRIBUTES", "deployment.environment=test")
        with serving(engine, tracer=telemetry.tracer()) as service:
            assert service.post(JPEG, traceparent=TRACEPARENT).status == 200
            until(lambda: "POST /features" in {span.name for span in sent(received)})
    assert {span.trace_id.hex() for span in sent(received)} == {TRACE}
    (resource, *_) = (part.resource for found in received for part in found.resource_spans)
    attributes = {item.key: item.value.string_value for item in resource.attributes}
    assert attributes["service.name"] == "driverview"
    assert attributes["deployment.environment"] == "test"


def sent(received: list[ExportTraceServiceRequest]) -> list[Any]:
    return [
        span
        for found in received
        for part in found.resource_spans
        for scope in part.scope_spans
        for span in scope.spans
    ]


def test_environment_variables_switch_tracing() -> None:
    endpoint = {"OTEL_EXPORTER_OTLP_ENDPOINT": "http://127.0.0.1:4318"}
    for environment, name in (
        ({}, None),
        (endpoint, "otlp_proto_http"),
        ({"OTEL_TRACES_EXPORTER": "console"}, "console"),
        ({**endpoint, "OTEL_TRACES_EXPORTER": "none"}, None),
        ({**endpoint, "OTEL_SDK_DISABLED": "true"}, None),
    ):
        assert telemetry.exporter_name(environment) == name
    with pytest.raises(
        UserError, match=r"exporter 'zipkin' is not installed.*driverview\[telemetry\]"
    ):
        telemetry.exporter_name({"OTEL_TRACES_EXPORTER": "zipkin"})


def test_without_tracing_no_exporter_is_loaded_or_endpoint_wrapped(service: Served) -> None:
    """Nor torch or physics. The OpenTelemetry API may be loaded, because FastAPI imports it."""
    code = (
        "import sys, serve.app, serve.worker, serve.launch, serve.client\n"
        "from serve.observability import telemetry\n"
        "assert telemetry.tracer() is None\n"
        "print({'opentelemetry.sdk', 'opentelemetry.exporter', 'serve.observability.tracing',"
        " 'torch', 'pybullet', 'simulator', 'datagen', 'numba', 'moderngl', 'mcap'}"
        " & set(sys.modules))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.stdout == "set()\n", done.stderr
    assert service.app.frames.tracer is None
    assert service.app._framework_app is service.app.framework
