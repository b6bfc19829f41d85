"""A request on its way in and out: its whole body within the limit, its answer in one go.

Plain ASGI, for the paths on which every microsecond counts.
"""

from collections.abc import Awaitable, Callable, MutableMapping
from typing import Any

import msgspec

from mtlnet.image_error import ImageError
from serve.ask import too_large
from serve.limits import MAX_BODY_BYTES
from serve.problems import MEDIA_TYPE, Problem, image_problem

Scope = MutableMapping[str, Any]
Message = MutableMapping[str, Any]
Receive = Callable[[], Awaitable[Message]]
Send = Callable[[Message], Awaitable[None]]
Header = tuple[bytes, bytes]

PROBLEM_HEADER: Header = (b"content-type", MEDIA_TYPE.encode())
encode_problem = msgspec.json.Encoder().encode


class Departed(Exception):
    """The client left before its body was whole: nobody waits for an answer."""


async def read_body(receive: Receive) -> bytes:
    """The whole body, as long as it stays within the limit. Raises Problem, Departed."""
    message = await receive()
    if message["type"] == "http.disconnect":
        raise Departed
    body: bytes = message.get("body", b"")
    if not message.get("more_body", False):
        _check_size(len(body))
        return body
    parts = bytearray(body)
    while message.get("more_body", False):
        message = await receive()
        if message["type"] == "http.disconnect":
            raise Departed
        parts += message.get("body", b"")
        _check_size(len(parts))
    return bytes(parts)


def _check_size(size: int) -> None:
    if size > MAX_BODY_BYTES:
        raise too_large(f"more than {MAX_BODY_BYTES} bytes")


async def reply(
    send: Send, status: int, headers: list[Header], body: bytes, way: str = "http"
) -> None:
    """Send a whole answer; `way` "websocket.http": to the handshake of a WebSocket."""
    headers.append((b"content-length", b"%d" % len(body)))
    await send({"type": f"{way}.response.start", "status": status, "headers": headers})
    await send({"type": f"{way}.response.body", "body": body})


async def refuse(send: Send, problem: Problem, headers: list[Header], way: str = "http") -> None:
    """Send a problem; `way` as in `reply`."""
    added = [(k.lower().encode(), v.encode()) for k, v in problem.headers.items()]
    content = encode_problem(problem.content)
    await reply(send, problem.kind.status, [PROBLEM_HEADER, *added, *headers], content, way)


def as_problem(error: Problem | ImageError) -> Problem:
    """What an error of the image's reader, or a problem already, is to a client."""
    return image_problem(error) if isinstance(error, ImageError) else error
