"""Asyncio client of the service, with one persistent connection and one request at a time.

    async with AsyncClient("http://127.0.0.1:8000") as client:
        answer = await client.features(jpeg_bytes, deadline_s=0.05)

It runs `serve.client.Client` in a separate thread. The requests of one client are sent one after
the other; for concurrent requests, use several clients.
"""

import asyncio
from collections.abc import Callable, Coroutine
from concurrent.futures import ThreadPoolExecutor
from functools import partial, wraps
from typing import Any, Concatenate, ParamSpec, TypeVar

from serve.client.sync import Client

P = ParamSpec("P")
T = TypeVar("T")


def _in_thread(
    method: Callable[Concatenate[Client, P], T],
) -> Callable[Concatenate["AsyncClient", P], Coroutine[Any, Any, T]]:
    """Make a coroutine method of `AsyncClient` of a method of `Client`, with the same arguments."""

    @wraps(method)
    async def call(self: "AsyncClient", /, *arguments: P.args, **options: P.kwargs) -> T:
        work = partial(method, self._client, *arguments, **options)
        return await asyncio.get_running_loop().run_in_executor(self._thread, work)

    return call


class AsyncClient:
    """A connection to the service at `url`; it has the methods of `serve.client.Client`."""

    def __init__(
        self,
        url: str = "http://127.0.0.1:8000",
        timeout_s: float = 5.0,
        token: str | None = None,
    ) -> None:
        """Connects at the first request. `timeout_s` is the time limit of one request. `token` is
        the service's token; the default is $DRIVERVIEW_TOKEN, if it is set. Raises ServiceError if
        `url` or `token` is not valid."""
        self._client = Client(url, timeout_s, token)
        self.url = self._client.url
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="driverview-client")
        self._closed = False

    features = _in_thread(Client.features)
    model = _in_thread(Client.model)
    ready = _in_thread(Client.ready)
    wait_until_ready = _in_thread(Client.wait_until_ready)
    _close = _in_thread(Client.close)

    async def close(self) -> None:
        """Close the connection and stop the thread; a second call has no effect."""
        if not self._closed:
            self._closed = True
            await self._close()
            self._thread.shutdown(wait=False)

    async def __aenter__(self) -> "AsyncClient":
        return self

    async def __aexit__(self, *_: object) -> None:
        await self.close()
