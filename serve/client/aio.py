"""The client of the service for asyncio: one connection, kept open; one request at a time on it.

    async with AsyncClient("http://127.0.0.1:8000") as client:
        answer = await client.features(jpeg_bytes, deadline_s=0.05)

It is `serve.client.Client` in a thread of its own, so that both follow the same rules. Requests of
one client wait for each other; for several at once, make several.
"""

import asyncio
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from types import TracebackType
from typing import Any, TypeVar

from serve.client.sync import Client

T = TypeVar("T")


class AsyncClient:
    """A connection to the service at `url`; see `serve.client.Client` for what its methods do."""

    def __init__(
        self,
        url: str = "http://127.0.0.1:8000",
        timeout_s: float = 5.0,
        token: str | None = None,
    ) -> None:
        """Raises ServiceError when `url` is none. Nothing is sent before the first request."""
        self._client = Client(url, timeout_s, token)
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="driverview-client")

    async def features(
        self,
        image: bytes,
        content_type: str | None = None,
        frame_id: str | None = None,
        *,
        stream: str | None = None,
        deadline_s: float | None = None,
    ) -> dict[str, Any]:
        """The service's answer to an image. Raises ServiceError."""
        ask = partial(self._client.features, stream=stream, deadline_s=deadline_s)
        return await self._in_thread(partial(ask, image, content_type, frame_id))

    async def model(self) -> dict[str, Any]:
        """The card of the model that answers. Raises ServiceError."""
        return await self._in_thread(self._client.model)

    async def ready(self) -> bool:
        """Whether the service answers images now."""
        return await self._in_thread(self._client.ready)

    async def close(self) -> None:
        """Close the connection and end the thread."""
        await self._in_thread(self._client.close)
        self._thread.shutdown(wait=False)

    async def __aenter__(self) -> "AsyncClient":
        return self

    async def __aexit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        await self.close()

    async def _in_thread(self, work: Callable[[], T]) -> T:
        return await asyncio.get_running_loop().run_in_executor(self._thread, work)
