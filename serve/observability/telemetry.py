"""Sets up OpenTelemetry traces (the extra `telemetry`) from the standard environment variables.

Traces are enabled by $OTEL_TRACES_EXPORTER (`otlp`, `console`; `none` disables them),
$OTEL_EXPORTER_OTLP_ENDPOINT or $OTEL_EXPORTER_OTLP_TRACES_ENDPOINT, and disabled by
$OTEL_SDK_DISABLED=true. Service name, resource, sampler, propagators and batches follow their
standard variables. Every process of the service imports this module, so it loads nothing heavy: the
exporter and `serve.observability.tracing` are imported only if traces are enabled.
"""

import os
from collections.abc import Mapping
from importlib.metadata import entry_points, version
from typing import TYPE_CHECKING, Any

from trackfeatures.errors import UserError

if TYPE_CHECKING:
    from opentelemetry.trace import Tracer

EXPORTER = "OTEL_TRACES_EXPORTER"
ENDPOINTS = ("OTEL_EXPORTER_OTLP_ENDPOINT", "OTEL_EXPORTER_OTLP_TRACES_ENDPOINT")
PROTOCOLS = ("OTEL_EXPORTER_OTLP_TRACES_PROTOCOL", "OTEL_EXPORTER_OTLP_PROTOCOL")
GROUP = "opentelemetry_traces_exporter"  # entry-point group of OpenTelemetry's exporters
BY_PROTOCOL = {"http/protobuf": "otlp_proto_http", "grpc": "otlp_proto_grpc"}
INSTALL = "pip install 'driverview[telemetry]'"


def exporter_name(environment: Mapping[str, str] = os.environ) -> str | None:
    """Return the entry-point name of the exporter that the environment selects; None if traces are
    disabled.

    Raises UserError if the exporter is not installed.
    """
    found = environment.get(EXPORTER, "").strip().lower()
    asked = found or any(environment.get(name) for name in ENDPOINTS)
    if not asked or found == "none" or environment.get("OTEL_SDK_DISABLED", "").lower() == "true":
        return None
    if found in ("", "otlp"):
        protocol = next((environment[name] for name in PROTOCOLS if environment.get(name)), None)
        found = BY_PROTOCOL.get(protocol or "http/protobuf", str(protocol))
    known = sorted(entry.name for entry in entry_points(group=GROUP))
    if found not in known:
        raise UserError(
            f"the trace exporter {found!r} is not installed (installed: "
            f"{', '.join(known) or 'none'}): {INSTALL}, or set {EXPORTER} to another one or to none"
        )
    return found


def tracer() -> "Tracer | None":
    """Create the tracer of this process with the selected exporter; None if traces are disabled."""
    name = exporter_name()
    if name is None:
        return None
    from opentelemetry.sdk.resources import Resource
    from opentelemetry.sdk.trace import TracerProvider
    from opentelemetry.sdk.trace.export import BatchSpanProcessor

    (entry,) = entry_points(group=GROUP, name=name)
    provider = TracerProvider(resource=Resource.create(_resource_attributes()))
    provider.add_span_processor(BatchSpanProcessor(entry.load()()))
    return provider.get_tracer("serve", version("driverview"))


def _resource_attributes() -> dict[str, Any]:
    attributes: dict[str, Any] = {
        "service.version": version("driverview"),
        "service.instance.id": str(os.getpid()),
    }
    named = "service.name=" in os.environ.get("OTEL_RESOURCE_ATTRIBUTES", "")
    if not named and not os.environ.get("OTEL_SERVICE_NAME"):
        attributes["service.name"] = "driverview"
    return attributes
