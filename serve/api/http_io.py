"""Reads the body of a request within the size limit, and writes a complete reply."""

from collections.abc import Awaitable, Callable, MutableMapping
from functools import lru_cache
from http import HTTPStatus
from typing import Any, NamedTuple

import msgspec

from serve.api.problems import MEDIA_TYPE, Problem, ProblemType, with_error
from serve.api.request_options import body_too_large
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
CACHED_PROBLEMS = 128  # number of encoded problems in the cache
_format_header = b"%b: %b\r\n".__mod__
_encode_json = msgspec.json.Encoder().encode


class Reply(NamedTuple):
    """A complete HTTP reply; `headers` does not include Content-Length."""

    status: int
    headers: list[Header]
    body: bytes


class ClientDisconnectedError(Exception):
    """The client closed the connection before its body was complete."""


async def read_body(receive: Receive, grow: Callable[[int], None]) -> bytes:
    """The complete body; `grow` is called with the size of each part in bytes.

    Raises Problem if the body is too large, ClientDisconnectedError, and the errors of `grow`.
    """
    body, more = bytearray(), True
    while more:
        message = await receive()
        if message["type"] == "http.disconnect":
            raise ClientDisconnectedError
        part = message.get("body", b"")
        check_body_size(len(body) + len(part))
        grow(len(part))
        body += part
        more = message.get("more_body", False)
    return bytes(body)


def check_body_size(size: int) -> None:
    """Raise Problem if a body of `size` bytes is too large."""
    if size > MAX_BODY_BYTES:
        raise body_too_large(f"more than {MAX_BODY_BYTES} bytes")


async def send_reply(send: Send, reply: Reply, protocol: str = "http") -> None:
    """Send a reply over ASGI; with `protocol` "websocket.http" it refuses a handshake."""
    headers = [*reply.headers, (b"content-length", b"%d" % len(reply.body))]
    await send({"type": f"{protocol}.response.start", "status": reply.status, "headers": headers})
    await send({"type": f"{protocol}.response.body", "body": reply.body})


def without_body(send: Send) -> Send:
    """`send` for answers to HEAD: the headers of GET, including Content-Length, without a body."""

    async def send_head(message: Message) -> None:
        await send({**message, "body": b""} if "body" in message else message)

    return send_head


def problem_reply(problem: Problem, *headers: Header, path: str = "") -> Reply:
    """The reply with the problem of a request for `path`, with additional `headers`."""
    fields = (problem.type, problem.detail, problem.retry_after_ms)
    own_headers, body = _encode_problem(*fields, path[:4])
    return Reply(problem.type.status, [*own_headers, *headers], body)


@lru_cache(CACHED_PROBLEMS)
def _encode_problem(
    problem_type: ProblemType, detail: str, retry_after_ms: int | None, path: str
) -> tuple[list[Header], bytes]:
    """The headers and body of a problem. Cached: an overloaded service repeats a few problems."""
    problem = Problem(problem_type, detail, retry_after_ms)
    headers = [(k.lower().encode(), v.encode()) for k, v in problem.headers.items()]
    return [PROBLEM_HEADER, *headers], _encode_json(with_error(problem.content, path))


def encode_head(reply: Reply, *extra: Header) -> bytes:
    """The bytes of a reply's status line and headers in HTTP/1.1; `extra` headers come first."""
    return b"%b%b%bcontent-length: %d\r\n\r\n" % (
        STATUS_LINES[reply.status],
        b"".join(map(_format_header, extra)),
        b"".join(map(_format_header, reply.headers)),
        len(reply.body),
    )
