"""WebSocket connections that report to the client why they are closed, also on a message that is
too long.
"""

from uvicorn.protocols.websockets.websockets_sansio_impl import WebSocketsSansIOProtocol

from serve.server.connection import LINGER_S


class GuardedWebSocket(WebSocketsSansIOProtocol):
    """One WebSocket connection."""

    _discarding = False

    def data_received(self, data: bytes) -> None:
        if not self._discarding:
            super().data_received(data)

    def handle_parser_exception(self) -> None:
        """Send the close frame, then discard what the client still sends for LINGER_S.

        A connection closed with unread bytes is reset, and the client would lose the close frame.
        """
        closing = self.conn.close_sent
        assert closing is not None
        self._discarding = self.close_sent = True
        self.stop_keepalive()
        self.queue.put_nowait(
            {"type": "websocket.disconnect", "code": closing.code, "reason": closing.reason}
        )
        self.transport.write(b"".join(self.conn.data_to_send()))
        if self.transport.can_write_eof():
            self.transport.write_eof()
        self.close_timer = self.loop.call_later(LINGER_S, self.transport.abort)
