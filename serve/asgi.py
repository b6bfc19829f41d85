"""Reads the client's address and the body of an ASGI request, and sends a reply over ASGI."""

from collections.abc import Awaitable, Callable, MutableMapping
from typing import Any

from serve.replies import Reply

Scope = MutableMapping[str, Any]
Message = MutableMapping[str, Any]
Receive = Callable[[], Awaitable[Message]]
Send = Callable[[Message], Awaitable[None]]
App = Callable[[Scope, Receive, Send], Awaitable[None]]


class ClientDisconnectedError(Exception):
    """The client closed the connection before its body was complete."""


def client_address(scope: Scope) -> str:
    """Return the client's address; it is empty if it is unknown."""
    client = scope.get("client")
    return client[0] if client else ""


async def read_body(receive: Receive, take: Callable[[int], None]) -> bytes:
    """Receive the complete body of a request; `take` is called with the size of each part in bytes.

    Raises ClientDisconnectedError, and the errors of `take`.
    """
    body, more = bytearray(), True
    while more:
        message = await receive()
        if message["type"] == "http.disconnect":
            raise ClientDisconnectedError
        part = message.get("body", b"")
        take(len(part))
        body += part
        more = message.get("more_body", False)
    return bytes(body)


async def send_reply(send: Send, reply: Reply, protocol: str = "http") -> None:
    """Send a reply; with `protocol` "websocket.http" the reply refuses a WebSocket handshake."""
    headers = [*reply.headers, (b"content-length", b"%d" % len(reply.body))]
    await send({"type": f"{protocol}.response.start", "status": reply.status, "headers": headers})
    await send({"type": f"{protocol}.response.body", "body": reply.body})


def without_body(send: Send) -> Send:
    """Return a `send` for answers to HEAD: it sends the headers of a GET (with Content-Length), no
    body."""

    async def send_head(message: Message) -> None:
        await send({**message, "body": b""} if "body" in message else message)

    return send_head
