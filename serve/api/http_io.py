"""A request on its way in and out: its whole body within the limit, its answer in one go."""

from collections.abc import Awaitable, Callable, MutableMapping
from functools import lru_cache
from http import HTTPStatus
from typing import Any, NamedTuple

import msgspec

from mtlnet.inference.image_decoding.errors import ImageError
from serve.api.problems import MEDIA_TYPE, Kind, Problem, image_problem
from serve.api.request_options import too_large
from serve.config import MAX_BODY_BYTES

Scope = MutableMapping[str, Any]
Message = MutableMapping[str, Any]
Receive = Callable[[], Awaitable[Message]]
Send = Callable[[Message], Awaitable[None]]
Header = tuple[bytes, bytes]

STATUS_LINES: dict[int, bytes] = {
    status: f"HTTP/1.1 {status} {status.phrase}\r\n".encode() for status in HTTPStatus
}
PROBLEM_HEADER: Header = (b"content-type", MEDIA_TYPE.encode())
KNOWN_PROBLEMS = 128  # whose replies are kept, ready to be sent again
encode_problem = msgspec.json.Encoder().encode


class Reply(NamedTuple):
    """A whole answer to a request; its length stands not in the headers."""

    status: int
    headers: list[Header]
    body: bytes


class Departed(Exception):
    """The client left before its body was whole: nobody waits for an answer."""


async def read_body(receive: Receive) -> bytes:
    """The whole body, as long as it stays within the limit. Raises Problem, Departed."""
    message = await receive()
    if message["type"] == "http.disconnect":
        raise Departed
    body: bytes = message.get("body", b"")
    if not message.get("more_body", False):
        check_size(len(body))
        return body
    parts = bytearray(body)
    while message.get("more_body", False):
        message = await receive()
        if message["type"] == "http.disconnect":
            raise Departed
        parts += message.get("body", b"")
        check_size(len(parts))
    return bytes(parts)


def check_size(size: int) -> None:
    """Raise Problem when a body of so many bytes is too large."""
    if size > MAX_BODY_BYTES:
        raise too_large(f"more than {MAX_BODY_BYTES} bytes")


async def reply(send: Send, whole: Reply, way: str = "http") -> None:
    """Send a reply; `way` "websocket.http": to the handshake of a WebSocket."""
    headers = [*whole.headers, (b"content-length", b"%d" % len(whole.body))]
    await send({"type": f"{way}.response.start", "status": whole.status, "headers": headers})
    await send({"type": f"{way}.response.body", "body": whole.body})


def refusal(problem: Problem, *headers: Header) -> Reply:
    """The reply that tells a client of a problem."""
    added, content = _told(problem.kind, problem.detail, problem.retry_after_ms)
    return Reply(problem.kind.status, [*added, *headers], content)


@lru_cache(KNOWN_PROBLEMS)
def _told(kind: Kind, detail: str, retry_after_ms: int | None) -> tuple[list[Header], bytes]:
    """The headers and the body that tell of a problem; an overloaded service says few things."""
    problem = Problem(kind, detail, retry_after_ms)
    added = [(k.lower().encode(), v.encode()) for k, v in problem.headers.items()]
    return [PROBLEM_HEADER, *added], encode_problem(problem.content)


def head_of(whole: Reply, *more: Header) -> bytes:
    """The bytes of a reply before its body, as HTTP/1.1 has them."""
    lines = [
        STATUS_LINES[whole.status],
        *[b"%b: %b\r\n" % header for header in more],
        *[b"%b: %b\r\n" % header for header in whole.headers],
        b"content-length: %d\r\n\r\n" % len(whole.body),
    ]
    return b"".join(lines)


def as_problem(error: Problem | ImageError) -> Problem:
    """What an error of the image's reader, or a problem already, is to a client."""
    return image_problem(error) if isinstance(error, ImageError) else error
