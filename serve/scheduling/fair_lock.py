"""A lock that clients hold in turns. A client is an IPv4 address or an IPv6 /64 network."""

import asyncio
from collections import deque
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

from serve.config import network_of


class FairLock:
    """A lock for the coroutines of one event loop; waiting clients take turns."""

    def __init__(self) -> None:
        self._locked = False
        # Waiting coroutines of each client; the first client is the next to get the lock.
        self._waiting: dict[str, deque[asyncio.Future[None]]] = {}

    @asynccontextmanager
    async def held(self, client: str) -> AsyncIterator[None]:
        """Wait for the lock as `client` (an address), and hold it within the context."""
        if self._locked:
            await self._wait(network_of(client))
        self._locked = True
        try:
            yield
        finally:
            self._release()

    async def _wait(self, client: str) -> None:
        turn = asyncio.get_running_loop().create_future()
        self._waiting.setdefault(client, deque()).append(turn)
        try:
            await turn
        except asyncio.CancelledError:
            if not turn.cancelled():  # cancelled after it got the lock
                self._release()
            raise

    def _release(self) -> None:
        """Give the lock to the next waiting client, or unlock."""
        while self._waiting:
            client, turns = next(iter(self._waiting.items()))
            del self._waiting[client]
            turn = turns.popleft()
            if turns:
                self._waiting[client] = turns
            if not turn.done():
                turn.set_result(None)
                return
        self._locked = False
