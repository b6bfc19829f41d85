"""Handles requests with an Upgrade header. If the request is the handshake of a WebSocket, a
WebSocket is opened. Any other upgrade is ignored, as RFC 9110 (7.8) allows."""

from typing import TYPE_CHECKING

from httptools import HttpRequestParser

from serve.problems import MALFORMED, Problem, stopping, too_many_requests
from serve.server.websocket import GuardedWebSocket

if TYPE_CHECKING:
    from serve.server.connection import GuardedProtocol

MAX_UPGRADES = 4  # upgrade requests in one read from the socket
IGNORED = frozenset({b"upgrade", b"http2-settings"})  # headers of an upgrade that is ignored


def parse_upgrades(connection: "GuardedProtocol", rest: bytes) -> None:
    """Handle the upgrade that stopped the parser, and parse `rest`, the bytes after its headers."""
    for _ in range(MAX_UPGRADES):
        rest = _upgrade(connection, rest)
        upgrade_at = connection.feed(rest) if rest else None
        if upgrade_at is None:
            return
        rest = rest[upgrade_at:]
    connection.close_with(too_many_requests(f"{MAX_UPGRADES} upgrades"))


def _upgrade(connection: "GuardedProtocol", rest: bytes) -> bytes:
    """Answer the handshake of a WebSocket (open the WebSocket, or refuse it) and return b"". For
    any other upgrade, return the request without its upgrade headers, followed by `rest`; the
    caller parses these bytes again."""
    connection.upgrading = False
    if connection.parser.get_method() == b"CONNECT":
        connection.send_400_response("")
    elif not connection._should_upgrade():
        head = _head(connection, ignored=IGNORED)
        connection.parser = HttpRequestParser(connection)
        connection.parser.set_dangerous_leniencies(lenient_data_after_close=True)
        return head + rest
    elif rest or not (connection.cycle is None or connection.cycle.response_complete):
        detail = "send a WebSocket handshake after all earlier replies, and no bytes behind it"
        connection.close_with(Problem(MALFORMED, detail))
    elif connection.guard.draining:
        connection.close_with(stopping())
    else:
        _open_websocket(connection)
    return b""


def _open_websocket(connection: "GuardedProtocol") -> None:
    """Hand the connection over to a `GuardedWebSocket`."""
    head = _head(connection)
    connection.leave()
    websocket = GuardedWebSocket(
        connection.config,
        connection.server_state,
        connection.app_state,
        connection.loop,
        guard=connection.guard,
    )
    websocket.network = connection.network
    websocket.connection_made(connection.transport)
    websocket.client = connection.client
    connection.transport.set_protocol(websocket)
    websocket.data_received(head)
    connection.parser = None  # type: ignore[assignment]  # breaks a reference cycle


def _head(connection: "GuardedProtocol", ignored: frozenset[bytes] = frozenset()) -> bytes:
    """The bytes of the request's head without the headers in `ignored` (lower case), which are also
    removed from the value of `Connection`."""
    parser = connection.parser
    version = parser.get_http_version().encode()
    lines = [b"%b %b HTTP/%b\r\n" % (parser.get_method(), connection.url, version)]
    for name, value in connection.headers:
        if name == b"connection" and ignored:
            options = [option.strip() for option in value.split(b",")]
            value = b", ".join(o for o in options if o.lower() not in ignored)
        if name not in ignored:
            lines.append(b"%b: %b\r\n" % (name, value))
    return b"".join(lines) + b"\r\n"
