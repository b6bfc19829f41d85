"""Lingering close: after its last reply the server reads until the client closes the connection.

Closing a connection with unread bytes resets it, and the client loses the reply (RFC 9112, 9.6).
"""

import asyncio
from typing import Protocol


class LingeringConnection(Protocol):
    """A connection that can end with a lingering close."""

    transport: asyncio.Transport

    def end(self) -> None:
        """Close after the last reply; if the client can still be sending, read until it closes."""


class LingeringTransport:
    """Replaces the transport of a connection for its last reply: `close` calls the connection's
    `end`, which can read on before it closes the connection."""

    def __init__(self, connection: LingeringConnection) -> None:
        self._connection = connection

    def write(self, data: bytes) -> None:
        """Send `data` to the client."""
        self._connection.transport.write(data)

    def is_closing(self) -> bool:
        """Whether the connection is closing, closed or lost."""
        return self._connection.transport.is_closing()

    def close(self) -> None:
        """End the connection after the written bytes."""
        self._connection.end()
