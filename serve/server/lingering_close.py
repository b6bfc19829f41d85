"""A lingering close: after its last reply a connection sends no more, and reads until the client
closes it.

A connection that is closed with unread bytes is reset, and the client loses the reply (RFC 9112,
9.6).
"""

import asyncio
from typing import Protocol


class LingeringConnection(Protocol):
    """A connection that can end with a lingering close."""

    transport: asyncio.Transport

    def end(self) -> None:
        """Close it after its last reply; the client closes first where it may still be sending."""


class LingeringTransport:
    """The transport of a connection for its last reply: `close` may let the client close first."""

    def __init__(self, connection: LingeringConnection) -> None:
        self._connection = connection

    def write(self, data: bytes) -> None:
        """Send."""
        self._connection.transport.write(data)

    def is_closing(self) -> bool:
        """Whether the connection is closed or lost."""
        return self._connection.transport.is_closing()

    def close(self) -> None:
        """Send no more."""
        self._connection.end()
