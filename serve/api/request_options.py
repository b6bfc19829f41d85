"""Reads and checks the options of a request: ids, stream, deadline, camera, field of view, format
of the answer (JSON or MessagePack), and the headers that describe the body.

All endpoints for images have the same options, as headers or in the query. The Open Inference
Protocol also accepts them in `parameters`, and /stream in a text message.
"""

import itertools
import json
import os
from collections.abc import Callable, Mapping, MutableMapping
from dataclasses import dataclass
from functools import lru_cache
from math import isfinite
from typing import Any
from urllib.parse import parse_qsl

import msgspec

from serve.config import MAX_BODY_BYTES, MAX_DEADLINE_MS, MAX_NAME
from serve.problems import (
    INVALID_REQUEST,
    NOT_ACCEPTABLE,
    UNSUPPORTED_TYPE,
    Problem,
    body_too_large,
)

FRAME_ID, REQUEST_ID, STREAM_ID = "X-Frame-Id", "X-Request-Id", "X-Stream-Id"
DEADLINE, FIELD_OF_VIEW, CAMERA = "X-Deadline-Ms", "X-Camera-Fov-Y", "X-Camera"
OPTIONS = {
    "frame_id": FRAME_ID,
    "stream_id": STREAM_ID,
    "deadline_ms": DEADLINE,
    "fov_y": FIELD_OF_VIEW,
    "camera": CAMERA,
}
"""The options of an image: names in a query or in JSON, with the equivalent headers."""
KEYS = {name: header.lower().encode() for name, header in OPTIONS.items()}
HEADER_KEYS = frozenset(KEYS.values())
# Prefixes of headers meant as options. A misspelt option must be refused: ignoring it would make
# the answer wrong.
OPTION_HEADERS = (
    *(b"x-camera", b"x-deadline", b"x-fov", b"x-frame-id", b"x-stream"),
    *(b"deadline", b"fov", b"frame-id", b"frame_id", b"stream-id", b"stream_id"),
)
KINDS = {
    "frame_id": (str | int, "text or a whole number"),
    "stream_id": (str | int, "text or a whole number"),
    "camera": (str, "text"),
}
"""Types of the options that are not numbers, with the names of these types."""
MAX_QUERY_FIELDS = 16  # largest number of fields in a query
SINGLE_HEADERS = (*OPTIONS.values(), REQUEST_ID, "Content-Type", "Content-Encoding")
MEDIA_TYPES = ("image/jpeg", "image/png")
IMAGE_MEDIA_TYPES = frozenset(name.encode() for name in MEDIA_TYPES)
MIN_FOV_DEG, MAX_FOV_DEG = 1.0, 179.0
MAX_ACCEPT = 1024  # characters of an Accept header; browsers send fewer than 200

Headers = dict[bytes, bytes]  # the keys are lower-case names

_process_id = os.urandom(4).hex()  # part of the request ids of this process
_request_numbers = itertools.count(1)


@dataclass(frozen=True, slots=True)
class ResponseFormat:
    """An encoding of the answer; `names` are the media types in Accept that select it."""

    media_type: str
    names: tuple[str, ...]
    encode: Callable[[Any], bytes]

    @property
    def header(self) -> tuple[bytes, bytes]:
        """Name and value of the Content-Type header of an answer."""
        return b"content-type", self.media_type.encode()


JSON = ResponseFormat("application/json", ("application/json",), msgspec.json.Encoder().encode)
MSGPACK = ResponseFormat(
    "application/msgpack",
    ("application/msgpack", "application/vnd.msgpack", "application/x-msgpack"),
    msgspec.msgpack.Encoder().encode,
)
TENSORS = ResponseFormat("application/octet-stream", ("application/octet-stream",), JSON.encode)
Formats = tuple[ResponseFormat, ...]
FORMATS: Formats = (JSON, MSGPACK)  # the first is the default
KSERVE_FORMATS: Formats = (JSON, TENSORS)


@lru_cache(256)
def negotiate(accept: str, formats: Formats = FORMATS) -> ResponseFormat:
    """Return the format that `accept` prefers (RFC 9110, 12.5.1). Raises Problem if there is
    none."""
    if not accept.strip():
        return formats[0]
    ranges = [_parse_media_range(item) for item in accept.split(",")]
    weights = [_quality(choice, ranges) for choice in formats]
    best = max(weights)
    if best <= 0:
        available = " and ".join(choice.media_type for choice in formats)
        raise Problem(NOT_ACCEPTABLE, f"Accept is {accept[:80]!r}; available are {available}")
    return formats[weights.index(best)]


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
    """The quality value of the most specific media range that matches a format."""
    for names in (choice.names, ("application/*",), ("*/*",)):
        matching = [weight for name, weight in ranges if name in names]
        if matching:
            return max(matching)
    return 0.0


@dataclass(frozen=True, slots=True)
class RequestOptions:
    """The options of one frame. Times are in ns of the monotonic clock; `stamp_ns` is the start of
    the request."""

    stamp_ns: int
    request_id: str = ""
    frame_id: str | None = None
    stream: str | None = None
    deadline_ns: int | None = None
    fov_y_deg: float | None = None
    camera: str | None = None
    format: ResponseFormat = JSON


def read_options(scope: MutableMapping[str, Any]) -> Headers:
    """Return the headers of an ASGI scope, to which the options in its query are added.

    Raises Problem, also for an option that is given twice: one of the values would be ignored.
    """
    headers: Headers = {}
    for name, value in scope["headers"]:
        if name in headers and name == b"accept":
            value = headers[name] + b"," + value
        headers[name] = value
    names = [name for name, _ in scope["headers"]]
    for header in SINGLE_HEADERS:
        if names.count(header.lower().encode()) > 1:
            raise Problem(INVALID_REQUEST, f"the request has more than one {header}; send one")
    return merge_options(headers, parse_query(scope["query_string"]), "the query")


def parse_query(query: bytes) -> dict[str, str]:
    """Return the options in a query by name. Raises Problem for an option that is given twice."""
    if not query:
        return {}
    try:
        text = query.decode("latin-1")
        pairs = parse_qsl(text, keep_blank_values=True, max_num_fields=MAX_QUERY_FIELDS)
    except ValueError as error:
        raise Problem(
            INVALID_REQUEST, f"the query has more than {MAX_QUERY_FIELDS} fields; send fewer"
        ) from error
    return single_options(pairs, "the query")


def single_options(pairs: list[tuple[str, Any]], where: str) -> dict[str, Any]:
    """Return the pairs (name, value) of options as a dictionary. Raises Problem if a name occurs
    twice; `where` is the source of the options, for the message."""
    found = dict(pairs)
    if len(found) < len(pairs):
        names = [name for name, _ in pairs]
        twice = next(name for name in names if names.count(name) > 1)
        raise Problem(INVALID_REQUEST, f"{twice[:40]!r} occurs twice in {where}; send it once")
    return found


def merge_options(headers: Headers, options: Mapping[str, Any], where: str) -> Headers:
    """Return `headers` with the `options` of a query or of a JSON object added as headers.
    Error messages name this source with the words `where`.

    Raises Problem for an option that is unknown, is also a header, or has the wrong type.
    """
    if not options:
        return headers
    check_names(options, OPTIONS, where)
    merged = dict(headers)
    for name, value in options.items():
        if KEYS[name] in headers:
            seen = f"{name} is in {where}, and again in {OPTIONS[name]} or the query"
            raise Problem(INVALID_REQUEST, f"{seen}; send it once")
        kinds, expected = KINDS.get(name, (str | int | float, "a number"))
        if isinstance(value, bool) or not isinstance(value, kinds):
            raise Problem(INVALID_REQUEST, f"{name} in {where} must be {expected}")
        merged[KEYS[name]] = str(value).encode("utf-8", "replace")
    return merged


def check_names(options: Mapping[str, Any], known: Mapping[str, Any], where: str) -> None:
    """Raise Problem if a name in `options` is not in `known`. `where` is the source of the options,
    for the message."""
    unknown = next((name for name in options if name not in known), None)
    if unknown is not None:
        raise Problem(
            INVALID_REQUEST,
            f"{where} has an unknown option {unknown[:40]!r}; known are {', '.join(known)}",
        )


def parse_json_object(text: str | bytes, where: str) -> dict[str, Any] | None:
    """Parse the JSON object in `text`; return None for a text that is no JSON object. Raises
    Problem if a name occurs twice; `where` is the text's origin, for the message."""
    try:
        content = json.loads(text, object_pairs_hook=lambda pairs: single_options(pairs, where))
    except (ValueError, RecursionError):
        return None
    return content if isinstance(content, dict) else None


def parse_options(
    headers: Headers, stamp_ns: int, request_id: str, formats: Formats = FORMATS
) -> RequestOptions:
    """Parse the options in the headers of a request that began at `stamp_ns` (ns of the monotonic
    clock). `formats` are the possible formats of the answer. Raises Problem."""
    for name in headers:
        if name.startswith(OPTION_HEADERS) and name not in HEADER_KEYS:
            seen = f"the request has an unknown header {name[:40].decode('latin-1')!r}"
            raise Problem(INVALID_REQUEST, f"{seen}; known are {', '.join(OPTIONS.values())}")
    return RequestOptions(
        stamp_ns,
        request_id,
        parse_name(headers.get(b"x-frame-id"), FRAME_ID),
        parse_name(headers.get(b"x-stream-id"), STREAM_ID),
        parse_deadline(headers.get(b"x-deadline-ms"), stamp_ns),
        parse_fov_deg(headers.get(b"x-camera-fov-y")),
        parse_name(headers.get(b"x-camera"), CAMERA),
        parse_format(headers.get(b"accept"), formats),
    )


def parse_format(accept: bytes | None, formats: Formats = FORMATS) -> ResponseFormat:
    """Return the format of the answer that the value of the Accept header requests. Raises
    Problem."""
    if accept is None or accept == b"*/*":
        return formats[0]
    if len(accept) > MAX_ACCEPT:
        seen = f"Accept has {len(accept)} characters; send at most {MAX_ACCEPT}"
        raise Problem(INVALID_REQUEST, seen)
    return negotiate(accept.decode("latin-1"), formats)


def parse_name(sent: bytes | None, header: str) -> str | None:
    """Return the name or id in `sent`, the value of a header; None without the header. `header` is
    the header's name, for the message. Raises Problem."""
    if sent is None:
        return None
    if not is_name(sent):
        raise Problem(
            INVALID_REQUEST,
            f"{header} has {len(sent)} characters; expected 1 to {MAX_NAME} of printable ASCII",
        )
    return sent.decode("ascii")


def is_name(sent: bytes) -> bool:
    """Whether `sent` is printable ASCII of 1 to 128 characters."""
    return 0 < len(sent) <= MAX_NAME and sent.isascii() and sent.decode("ascii").isprintable()


def request_id_of(headers: Headers) -> str:
    """Return the id of a request: the client's id if it is valid, else a new id."""
    sent = headers.get(b"x-request-id")
    if sent and is_name(sent):
        return sent.decode("ascii")
    return f"{_process_id}-{next(_request_numbers):x}"


def parse_deadline(sent: bytes | str | None, stamp_ns: int) -> int | None:
    """Convert a deadline, sent in ms after `stamp_ns`, to ns of the monotonic clock; None if no
    deadline was sent. Raises Problem."""
    if sent is None:
        return None
    wait_ms = _parse_number(sent, DEADLINE, 0.0, MAX_DEADLINE_MS)
    return stamp_ns + round(1e6 * wait_ms)


def parse_fov_deg(sent: bytes | str | None) -> float | None:
    """Parse the vertical field of view of an image, sent in degrees (1 to 179); None if it was not
    sent. Raises Problem."""
    return None if sent is None else _parse_number(sent, FIELD_OF_VIEW, MIN_FOV_DEG, MAX_FOV_DEG)


def _parse_number(sent: bytes | str, header: str, low: float, high: float) -> float:
    text = sent.decode("latin-1") if isinstance(sent, bytes) else sent
    try:
        # float() accepts 1_000 and non-ASCII digits; other languages do not.
        value = float(text) if text.isascii() and "_" not in text else float("nan")
    except ValueError:
        value = float("nan")
    if not (isfinite(value) and low <= value <= high):
        raise Problem(
            INVALID_REQUEST,
            f"{header} is {text[:40]!r}; expected a number from {low:g} to {high:g}",
        )
    return value


def check_image_headers(headers: Headers) -> None:
    """Raise Problem unless the headers announce a JPEG or PNG file, uncompressed and not too
    large."""
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
    """Raise Problem if the headers announce a compressed body or a body of more than 4 MiB."""
    coding = headers.get(b"content-encoding", b"identity")
    if coding.strip().lower() != b"identity":
        raise Problem(
            UNSUPPORTED_TYPE,
            f"the body has Content-Encoding {coding[:40].decode('latin-1')!r}; post it without one",
        )
    length = headers.get(b"content-length", b"")
    if length.isdigit() and int(length[:20]) > MAX_BODY_BYTES:
        raise body_too_large(f"{int(length[:20])} bytes")
