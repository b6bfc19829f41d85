"""A WebSocket whose end the client learns of, even in the middle of a message that is too long."""

from uvicorn.protocols.websockets.websockets_sansio_impl import WebSocketsSansIOProtocol

from serve.server.connection import LINGER_S


class GuardedWebSocket(WebSocketsSansIOProtocol):
    """One WebSocket connection, from its handshake on."""

    _ended = False

    def data_received(self, data: bytes) -> None:
        if not self._ended:
            super().data_received(data)

    def handle_parser_exception(self) -> None:
        """Say why, then read on for a while without listening.

        Closed with bytes unread, a connection is reset, and the reset overtakes the reason.
        """
        closing = self.conn.close_sent
        assert closing is not None
        self._ended = self.close_sent = True
        self.stop_keepalive()
        self.queue.put_nowait(
            {"type": "websocket.disconnect", "code": closing.code, "reason": closing.reason}
        )
        self.transport.write(b"".join(self.conn.data_to_send()))
        if self.transport.can_write_eof():
            self.transport.write_eof()
        self.close_timer = self.loop.call_later(LINGER_S, self.transport.abort)
