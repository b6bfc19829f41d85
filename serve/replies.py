"""Complete HTTP replies, among them the reply with a problem, and their bytes in HTTP/1.1."""

from functools import lru_cache
from http import HTTPStatus
from typing import NamedTuple

import msgspec

from serve.problems import MEDIA_TYPE, Problem, ProblemType, with_error

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


def problem_reply(problem: Problem, *headers: Header, path: str = "") -> Reply:
    """Make the reply with `problem` to a request for `path`, with additional `headers`."""
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
    """Encode a reply's status line and headers in HTTP/1.1; `extra` headers come first."""
    return b"%b%b%bcontent-length: %d\r\n\r\n" % (
        STATUS_LINES[reply.status],
        b"".join(map(_format_header, extra)),
        b"".join(map(_format_header, reply.headers)),
        len(reply.body),
    )
