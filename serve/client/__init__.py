"""The client of the service: blocking (`Client`) and for asyncio (`AsyncClient`)."""

from serve.client.aio import AsyncClient
from serve.client.sync import Client, ServiceError

__all__ = ["AsyncClient", "Client", "ServiceError"]
