"""An answer as bytes: JSON or MessagePack, whichever the client's `Accept` prefers."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import msgspec

from serve.problems import NOT_ACCEPTABLE, Problem


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
