"""The options of one request, read and checked from its headers: ids, stream, deadline, field of
view, the format of the answer (JSON or MessagePack), the token, and the declared body.
"""

import itertools
import os
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from hmac import compare_digest
from math import isfinite
from typing import Any

import msgspec

from serve.api.problems import (
    BODY_TOO_LARGE,
    INVALID_REQUEST,
    NOT_ACCEPTABLE,
    UNAUTHORIZED,
    UNSUPPORTED_TYPE,
    Problem,
)
from serve.config import MAX_BODY_BYTES, MAX_DEADLINE_MS, MAX_NAME

FRAME_ID, REQUEST_ID, STREAM_ID = "X-Frame-Id", "X-Request-Id", "X-Stream-Id"
DEADLINE, FIELD_OF_VIEW = "X-Deadline-Ms", "X-Camera-Fov-Y"
MEDIA_TYPES = ("image/jpeg", "image/png")
IMAGE_MEDIA_TYPES = frozenset(name.encode() for name in MEDIA_TYPES)
MIN_FOV_DEG, MAX_FOV_DEG = 1.0, 179.0
MAX_ACCEPT = 1024  # characters of an Accept header: browsers send fewer than 200

Headers = dict[bytes, bytes]  # by lower-case name

_process_id = os.urandom(4).hex()  # part of the request ids that this process makes
_request_numbers = itertools.count(1)


@dataclass(frozen=True, slots=True)
class ResponseFormat:
    """An encoding of the answer; `names` are the media types that select it."""

    media_type: str
    names: tuple[str, ...]
    encode: Callable[[Any], bytes]

    @property
    def header(self) -> tuple[bytes, bytes]:
        """The Content-Type header of an answer."""
        return b"content-type", self.media_type.encode()


JSON = ResponseFormat("application/json", ("application/json",), msgspec.json.Encoder().encode)
MSGPACK = ResponseFormat(
    "application/msgpack",
    ("application/msgpack", "application/vnd.msgpack", "application/x-msgpack"),
    msgspec.msgpack.Encoder().encode,
)
FORMATS = (JSON, MSGPACK)  # the first is preferred where the client has no preference


@lru_cache(256)
def negotiate(accept: str) -> ResponseFormat:
    """The format that an `Accept` header prefers (RFC 9110, 12.5.1). Raises Problem."""
    if not accept.strip():
        return JSON
    ranges = [_parse_media_range(item) for item in accept.split(",")]
    weights = [_quality(choice, ranges) for choice in FORMATS]
    best = max(weights)
    if best <= 0:
        raise Problem(
            NOT_ACCEPTABLE,
            f"Accept is {accept[:80]!r}; available are {JSON.media_type} and {MSGPACK.media_type}",
        )
    return FORMATS[weights.index(best)]


def _parse_media_range(item: str) -> tuple[str, float]:
    name, *parameters = (part.strip().lower() for part in item.split(";"))
    weight = 1.0
    for parameter in parameters:
        key, _, value = parameter.partition("=")
        if key.strip() == "q":
            try:
                weight = float(value)
            except ValueError:
                weight = 0.0
    return name, weight


def _quality(choice: ResponseFormat, ranges: list[tuple[str, float]]) -> float:
    """The quality value of a format: that of the most specific media range that matches it."""
    for names in (choice.names, ("application/*",), ("*/*",)):
        matching = [weight for name, weight in ranges if name in names]
        if matching:
            return max(matching)
    return 0.0


@dataclass(frozen=True, slots=True)
class RequestOptions:
    """The options of one frame. Times are ns of the monotonic clock; `stamp_ns`: its arrival."""

    stamp_ns: int
    request_id: str = ""
    frame_id: str | None = None
    stream: str | None = None
    deadline_ns: int | None = None
    fov_y_deg: float | None = None
    format: ResponseFormat = JSON


def parse_options(headers: Headers, stamp_ns: int, request_id: str) -> RequestOptions:
    """The options in the headers of a request. Raises Problem."""
    return RequestOptions(
        stamp_ns,
        request_id,
        parse_name(headers.get(b"x-frame-id"), FRAME_ID),
        parse_name(headers.get(b"x-stream-id"), STREAM_ID),
        parse_deadline(headers.get(b"x-deadline-ms"), stamp_ns),
        parse_fov_deg(headers.get(b"x-camera-fov-y")),
        parse_format(headers.get(b"accept")),
    )


def parse_format(accept: bytes | None) -> ResponseFormat:
    """The format of the answer. Raises Problem."""
    if accept is None or accept == b"*/*":
        return JSON
    if len(accept) > MAX_ACCEPT:
        seen = f"Accept has {len(accept)} characters, at most {MAX_ACCEPT} are read"
        raise Problem(INVALID_REQUEST, seen)
    return negotiate(accept.decode("latin-1"))


def parse_name(sent: bytes | None, header: str) -> str | None:
    """The value of a header that holds a name; None without it. Raises Problem."""
    if sent is None:
        return None
    if not is_name(sent):
        raise Problem(
            INVALID_REQUEST,
            f"{header} has {len(sent)} characters; expected at most {MAX_NAME}, printable ASCII",
        )
    return sent.decode("ascii")


def is_name(sent: bytes) -> bool:
    """Whether `sent` is short and printable ASCII."""
    return len(sent) <= MAX_NAME and sent.isascii() and sent.decode("ascii").isprintable()


def request_id_of(headers: Headers) -> str:
    """The id of a request: the client's own where it is valid, else a new one."""
    sent = headers.get(b"x-request-id")
    if sent and is_name(sent):
        return sent.decode("ascii")
    return f"{_process_id}-{next(_request_numbers):x}"


def parse_deadline(sent: bytes | str | None, stamp_ns: int) -> int | None:
    """The time of a deadline given in ms after `stamp_ns`, ns. Raises Problem."""
    if sent is None:
        return None
    wait_ms = _parse_number(sent, DEADLINE, 0.0, MAX_DEADLINE_MS)
    return stamp_ns + round(1e6 * wait_ms)


def parse_fov_deg(sent: bytes | str | None) -> float | None:
    """The vertical field of view of an image, degrees. Raises Problem."""
    return None if sent is None else _parse_number(sent, FIELD_OF_VIEW, MIN_FOV_DEG, MAX_FOV_DEG)


def _parse_number(sent: bytes | str, header: str, low: float, high: float) -> float:
    text = sent.decode("latin-1") if isinstance(sent, bytes) else sent
    try:
        value = float(text) if text.isascii() else float("nan")
    except ValueError:
        value = float("nan")
    if not (isfinite(value) and low <= value <= high):
        raise Problem(
            INVALID_REQUEST,
            f"{header} is {text[:40]!r}; expected a number from {low:g} to {high:g}",
        )
    return value


def check_token(headers: Headers, token: str | None) -> None:
    """Raise Problem unless the request carries the service's token."""
    if token is None:
        return
    scheme, _, sent = headers.get(b"authorization", b"").partition(b" ")
    if scheme.lower() != b"bearer" or not compare_digest(sent.strip(), token.encode()):
        raise Problem(
            UNAUTHORIZED, "send the service's token with the header Authorization: Bearer TOKEN"
        )


def check_image_headers(headers: Headers) -> None:
    """Raise Problem when the headers show that the body is not a usable image."""
    sent = headers.get(b"content-type", b"")
    if (
        sent not in IMAGE_MEDIA_TYPES
        and sent.partition(b";")[0].strip().lower() not in IMAGE_MEDIA_TYPES
    ):
        seen = f"is {sent[:80].decode('latin-1')!r}" if sent else "has no Content-Type"
        raise Problem(
            UNSUPPORTED_TYPE,
            f"the body {seen}; post the bytes of the file itself with the header "
            "Content-Type: image/jpeg (or image/png)",
        )
    check_body_headers(headers)


def check_body_headers(headers: Headers) -> None:
    """Raise Problem when the headers announce a compressed or too large body."""
    coding = headers.get(b"content-encoding", b"identity")
    if coding.strip().lower() != b"identity":
        raise Problem(
            UNSUPPORTED_TYPE,
            f"the body has Content-Encoding {coding[:40].decode('latin-1')!r}; post it as it is",
        )
    length = headers.get(b"content-length", b"")
    if length.isdigit() and int(length[:20]) > MAX_BODY_BYTES:
        raise body_too_large(f"{int(length[:20])} bytes")


def body_too_large(seen: str) -> Problem:
    """The problem of a body that is too large; `seen` describes its size."""
    return Problem(
        BODY_TOO_LARGE,
        f"the body has {seen}, the limit is {MAX_BODY_BYTES}; send a smaller image or "
        "compress it more",
    )
