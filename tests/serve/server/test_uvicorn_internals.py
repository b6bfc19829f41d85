"""The internals of uvicorn that `serve.server` uses; uvicorn can change them in any release.

If a test fails here, adapt `serve.server` to uvicorn's change, then the bounds in pyproject.toml.
"""

import asyncio
import inspect
import tomllib
from importlib.metadata import version
from pathlib import Path

import pytest
import uvicorn
from packaging.requirements import Requirement
from uvicorn.protocols.http.flow_control import FlowControl
from uvicorn.protocols.http.httptools_impl import HttpToolsProtocol, RequestResponseCycle
from uvicorn.protocols.websockets.websockets_sansio_impl import WebSocketsSansIOProtocol
from uvicorn.server import ServerState

RELIED_ON: dict[type, tuple[str, ...]] = {
    HttpToolsProtocol: (
        "_should_upgrade",
        "_start_asgi_task",
        "connection_lost",
        "connection_made",
        "data_received",
        "on_body",
        "on_header",
        "on_headers_complete",
        "on_message_begin",
        "on_message_complete",
        "on_response_complete",
        "on_url",
        "pause_writing",
        "resume_writing",
        "send_400_response",
    ),
    WebSocketsSansIOProtocol: (
        "connection_lost",
        "connection_made",
        "data_received",
        "handle_events",
        "handle_parser_exception",
        "handle_ping",
        "pause_writing",
        "resume_writing",
        "send",
        "send_receive_event_to_app",
        "stop_keepalive",
    ),
    FlowControl: ("pause_reading", "resume_reading"),
    uvicorn.Server: ("capture_signals", "handle_exit", "on_tick", "shutdown", "startup"),
}
PROTOCOL_STATE = (
    "app_state",
    "client",
    "config",
    "connections",
    "cycle",
    "flow",
    "headers",
    "loop",
    "parser",
    "pipeline",
    "server_state",
    "transport",
)
WEBSOCKET_STATE = (
    "close_sent",
    "close_timer",
    "conn",
    "curr_msg_data_type",
    "frames",
    "handshake_initiated",
    "loop",
    "queue",
    "read_paused",
    "transport",
    "writable",
)
CYCLE_STATE = ("disconnected", "keep_alive", "message_event", "response_complete")


def test_the_installed_version_is_within_the_bounds_of_the_project() -> None:
    project = tomllib.loads((Path(__file__).parents[3] / "pyproject.toml").read_text())
    found = [Requirement(text) for text in project["project"]["dependencies"]]
    (uvicorn_requirement,) = [one for one in found if one.name == "uvicorn"]
    operators = {one.operator for one in uvicorn_requirement.specifier}
    assert operators == {">=", "<"}
    assert version("uvicorn") in uvicorn_requirement.specifier


@pytest.mark.parametrize("base", RELIED_ON, ids=lambda base: str(base.__name__))
def test_the_methods_that_are_overridden_or_called_exist(base: type) -> None:
    assert [name for name in RELIED_ON[base] if not callable(getattr(base, name, None))] == []


def test_the_attributes_that_are_read_exist() -> None:
    config = uvicorn.Config(WebSocketsSansIOProtocol, http="httptools", loop="asyncio")
    config.load()
    loop = asyncio.new_event_loop()
    try:
        protocol = HttpToolsProtocol(config, ServerState(), {}, _loop=loop)
        websocket = WebSocketsSansIOProtocol(config, ServerState(), {}, _loop=loop)
    finally:
        loop.close()
    declared = {**HttpToolsProtocol.__dict__, **vars(protocol)}
    assert [name for name in PROTOCOL_STATE if name not in declared] == []
    assert [name for name in WEBSOCKET_STATE if not hasattr(websocket, name)] == []
    assert "self.url = " in inspect.getsource(HttpToolsProtocol.on_message_begin)
    source = inspect.getsource(RequestResponseCycle.__init__)
    assert [name for name in CYCLE_STATE if f"self.{name}" not in source] == []
    source = inspect.getsource(FlowControl)
    assert "self.write_paused" in source
