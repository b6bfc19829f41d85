"""An answer as bytes: JSON or MessagePack, whichever the client's `Accept` prefers."""

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


@dataclass(frozen=True, slots=True)
class Format:
    """One way to write an answer; `names` are the media types that ask for it."""

    media_type: str
    names: tuple[str, ...]
    encode: Callable[[Any], bytes]

    @property
    def header(self) -> tuple[bytes, bytes]:
        """The Content-Type header of an answer."""
        return b"content-type", self.media_type.encode()


JSON = Format("application/json", ("application/json",), msgspec.json.Encoder().encode)
MSGPACK = Format(
    "application/msgpack",
    ("application/msgpack", "application/vnd.msgpack", "application/x-msgpack"),
    msgspec.msgpack.Encoder().encode,
)
FORMATS = (JSON, MSGPACK)  # in the order of our own preference


@lru_cache(256)
def negotiate(accept: str) -> Format:
    """The format that an `Accept` header asks for (RFC 9110, 12.5.1). Raises Problem."""
    if not accept.strip():
        return JSON
    ranges = [_read_range(item) for item in accept.split(",")]
    weights = [_weight(found, ranges) for found in FORMATS]
    best = max(weights)
    if best <= 0:
        raise Problem(
            NOT_ACCEPTABLE,
            f"Accept is {accept[:80]!r}; the answers are {JSON.media_type} or {MSGPACK.media_type}",
        )
    return FORMATS[weights.index(best)]


def _read_range(item: str) -> tuple[str, float]:
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


def _weight(found: Format, ranges: list[tuple[str, float]]) -> float:
    """What the most specific range that fits says of a format."""
    for names in (found.names, ("application/*",), ("*/*",)):
        fitting = [weight for name, weight in ranges if name in names]
        if fitting:
            return max(fitting)
    return 0.0


# What a client asks for beside the image: its headers, read and checked once.


FRAME_ID, REQUEST_ID, STREAM_ID = "X-Frame-Id", "X-Request-Id", "X-Stream-Id"
DEADLINE, FIELD_OF_VIEW = "X-Deadline-Ms", "X-Camera-Fov-Y"
MEDIA_TYPES = ("image/jpeg", "image/png")
KNOWN_TYPES = frozenset(name.encode() for name in MEDIA_TYPES)
MIN_FOV_DEG, MAX_FOV_DEG = 1.0, 179.0

Headers = dict[bytes, bytes]  # by lower-case name

_run = os.urandom(4).hex()
_numbers = itertools.count(1)


@dataclass(frozen=True, slots=True)
class RequestOptions:
    """What one frame asks for. `stamp_ns` is when it arrived; `deadline_ns` None: none."""

    stamp_ns: int
    request_id: str = ""
    frame_id: str | None = None
    stream: str | None = None
    deadline_ns: int | None = None
    fov_y_deg: float | None = None
    format: Format = JSON


def read_ask(headers: Headers, stamp_ns: int, name: str) -> RequestOptions:
    """What the headers of the request called `name` ask for. Raises Problem."""
    return RequestOptions(
        stamp_ns,
        name,
        read_name(headers.get(b"x-frame-id"), FRAME_ID),
        read_name(headers.get(b"x-stream-id"), STREAM_ID),
        read_deadline(headers.get(b"x-deadline-ms"), stamp_ns),
        read_fov(headers.get(b"x-camera-fov-y")),
        read_format(headers.get(b"accept")),
    )


def read_format(accept: bytes | None) -> Format:
    """The format of the answer. Raises Problem."""
    if accept is None or accept == b"*/*":
        return JSON
    return negotiate(accept.decode("latin-1"))


def read_name(sent: bytes | None, header: str) -> str | None:
    """The name in a header, None without it. Raises Problem."""
    if sent is None:
        return None
    if not is_name(sent):
        raise Problem(
            INVALID_REQUEST,
            f"{header} has {len(sent)} characters; at most {MAX_NAME} of printable ASCII are taken",
        )
    return sent.decode("ascii")


def is_name(sent: bytes) -> bool:
    """Whether `sent` is short and printable ASCII."""
    return len(sent) <= MAX_NAME and sent.isascii() and sent.decode("ascii").isprintable()


def request_id(headers: Headers) -> str:
    """The request's id: the client's own where it is one, else a new one."""
    sent = headers.get(b"x-request-id")
    if sent and is_name(sent):
        return sent.decode("ascii")
    return f"{_run}-{next(_numbers):x}"


def read_deadline(sent: bytes | str | None, stamp_ns: int) -> int | None:
    """When a frame is too late, ns of the monotonic clock. Raises Problem."""
    if sent is None:
        return None
    wait_ms = _number(sent, DEADLINE, 0.0, MAX_DEADLINE_MS)
    return stamp_ns + round(1e6 * wait_ms)


def read_fov(sent: bytes | str | None) -> float | None:
    """A vertical field of view, degrees. Raises Problem."""
    return None if sent is None else _number(sent, FIELD_OF_VIEW, MIN_FOV_DEG, MAX_FOV_DEG)


def _number(sent: bytes | str, header: str, low: float, high: float) -> float:
    text = sent.decode("latin-1") if isinstance(sent, bytes) else sent
    try:
        value = float(text) if text.isascii() else float("nan")
    except ValueError:
        value = float("nan")
    if not (isfinite(value) and low <= value <= high):
        raise Problem(
            INVALID_REQUEST,
            f"{header} is {text[:40]!r}; a number from {low:g} to {high:g} is taken",
        )
    return value


def check_token(headers: Headers, token: str | None) -> None:
    """Refuse whoever does not know the service's token. Raises Problem."""
    if token is None:
        return
    scheme, _, sent = headers.get(b"authorization", b"").partition(b" ")
    if scheme.lower() != b"bearer" or not compare_digest(sent.strip(), token.encode()):
        raise Problem(
            UNAUTHORIZED, "send the service's token with the header Authorization: Bearer TOKEN"
        )


def check_headers(headers: Headers) -> None:
    """Refuse a body that the headers alone rule out. Raises Problem."""
    sent = headers.get(b"content-type", b"")
    if sent not in KNOWN_TYPES and sent.partition(b";")[0].strip().lower() not in KNOWN_TYPES:
        seen = f"is {sent[:80].decode('latin-1')!r}" if sent else "has no Content-Type"
        raise Problem(
            UNSUPPORTED_TYPE,
            f"the body {seen}; post the bytes of the file itself with the header "
            "Content-Type: image/jpeg (or image/png)",
        )
    check_body_headers(headers)


def check_body_headers(headers: Headers) -> None:
    """Refuse a body that is compressed or too long. Raises Problem."""
    coding = headers.get(b"content-encoding", b"identity")
    if coding.strip().lower() != b"identity":
        raise Problem(
            UNSUPPORTED_TYPE,
            f"the body has Content-Encoding {coding[:40].decode('latin-1')!r}; post it as it is",
        )
    length = headers.get(b"content-length", b"")
    if length.isdigit() and int(length[:20]) > MAX_BODY_BYTES:
        raise too_large(f"{int(length[:20])} bytes")


def too_large(seen: str) -> Problem:
    """The problem that a body of so many bytes is."""
    return Problem(
        BODY_TOO_LARGE,
        f"the body has {seen}, at most {MAX_BODY_BYTES} are taken; send a smaller image or "
        "compress it more",
    )
