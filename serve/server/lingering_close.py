"""Lingering close: the server sends its last reply, then reads until the client closes.

Closing a connection with unread bytes resets it, and the client loses the reply (RFC 9112, 9.6).
"""

import asyncio
from typing import Protocol


class LingeringConnection(Protocol):
    """A connection that can end with a lingering close."""

    transport: asyncio.Transport

    def end(self) -> None:
        """Close after the last reply; with a lingering close if the client can still be sending."""


class LingeringTransport:
    """The transport for a connection's last reply: its `close` calls the connection's `end`."""

    def __init__(self, connection: LingeringConnection) -> None:
        self._connection = connection

    def write(self, data: bytes) -> None:
        """Send bytes."""
        self._connection.transport.write(data)

    def is_closing(self) -> bool:
        """Whether the connection is closing, closed or lost."""
        return self._connection.transport.is_closing()

    def close(self) -> None:
        """End the connection after what was written."""
        self._connection.end()
