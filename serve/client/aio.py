"""Asyncio client of the service, with one persistent connection and one request at a time.

    async with AsyncClient("http://127.0.0.1:8000") as client:
        answer = await client.features(jpeg_bytes, deadline_s=0.05)

It runs `serve.client.Client` in a separate thread. The requests of one client are sent one after
the other; for concurrent requests, use several clients.
"""

import asyncio
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Any, TypeVar

from serve.client.sync import Client

T = TypeVar("T")


class AsyncClient:
    """A connection to the service at `url`; the methods are those of `serve.client.Client`."""

    def __init__(
        self,
        url: str = "http://127.0.0.1:8000",
        timeout_s: float = 5.0,
        token: str | None = None,
    ) -> None:
        """Raises ServiceError if `url` is not valid. Connects at the first request."""
        self._client = Client(url, timeout_s, token)
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="driverview-client")
        self._closed = False

    async def features(
        self,
        image: bytes,
        content_type: str | None = None,
        frame_id: str | None = None,
        *,
        stream: str | None = None,
        deadline_s: float | None = None,
        fov_y_deg: float | None = None,
        camera: str | None = None,
    ) -> dict[str, Any]:
        """The track features of a JPEG or PNG file. Raises ServiceError."""
        options: dict[str, Any] = {
            "stream": stream,
            "deadline_s": deadline_s,
            "fov_y_deg": fov_y_deg,
            "camera": camera,
        }
        send = partial(self._client.features, image, content_type, frame_id, **options)
        return await self._in_thread(send)

    async def model(self) -> dict[str, Any]:
        """The card of the served model. Raises ServiceError."""
        return await self._in_thread(self._client.model)

    async def ready(self) -> bool:
        """Whether the service can answer images."""
        return await self._in_thread(self._client.ready)

    async def close(self) -> None:
        """Close the connection and stop the thread; a second call has no effect."""
        if not self._closed:
            self._closed = True
            await self._in_thread(self._client.close)
            self._thread.shutdown(wait=False)

    async def __aenter__(self) -> "AsyncClient":
        return self

    async def __aexit__(self, *_: object) -> None:
        await self.close()

    async def _in_thread(self, work: Callable[[], T]) -> T:
        return await asyncio.get_running_loop().run_in_executor(self._thread, work)
