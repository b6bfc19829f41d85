"""Clients of the service: `Client` (blocking) and `AsyncClient` (asyncio)."""

from serve.client.aio import AsyncClient
from serve.client.sync import Client, ServiceError

__all__ = ["AsyncClient", "Client", "ServiceError"]
