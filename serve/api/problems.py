"""What the service says when it cannot answer: RFC 9457 problems, each kind with a stable type.

A problem's `type` names its kind and never changes; `detail` says what was seen and what to do.
"""

from dataclasses import dataclass
from math import ceil
from typing import Any

from mtlnet.inference.image_decoding.errors import Fault, ImageError
from trackfeatures.errors import UserError

MEDIA_TYPE = "application/problem+json"


@dataclass(frozen=True, slots=True)
class Kind:
    """One kind of problem: its name in the type URI, its HTTP status, its title."""

    name: str
    status: int
    title: str

    @property
    def type(self) -> str:
        """The type URI, relative to the service's address."""
        return f"/problems/{self.name}"


MALFORMED = Kind("malformed-request", 400, "This is no HTTP request")
UNAUTHORIZED = Kind("unauthorized", 401, "The token is missing or wrong")
FORBIDDEN_ORIGIN = Kind("forbidden-origin", 403, "Another site's page may not use this service")
NOT_FOUND = Kind("not-found", 404, "There is nothing at this path")
METHOD_NOT_ALLOWED = Kind("method-not-allowed", 405, "This path does not take this method")
NOT_ACCEPTABLE = Kind("not-acceptable", 406, "The answer cannot be had in the accepted types")
TOO_SLOW = Kind("request-timeout", 408, "The request came too slowly")
BODY_TOO_LARGE = Kind("body-too-large", 413, "The body is too large")
UNSUPPORTED_TYPE = Kind("unsupported-media-type", 415, "The body has another type than an image")
INVALID_REQUEST = Kind("invalid-request", 422, "The request is not understood")
NOT_AN_IMAGE = Kind("not-an-image", 422, "The body is no JPEG or PNG image")
DAMAGED_IMAGE = Kind("damaged-image", 422, "The image is damaged or incomplete")
UNSUPPORTED_IMAGE = Kind("unsupported-image", 422, "The image has a coding that is not supported")
TRAILING_BYTES = Kind("trailing-bytes", 422, "More than the image is in the body")
IMAGE_SIZE = Kind("image-size", 422, "The image is too small or too large")
IMAGE_ASPECT = Kind("image-aspect", 422, "The image has another shape than the model's camera")
FIELD_OF_VIEW = Kind("field-of-view", 422, "The image shows less than the model's camera does")
RATE_LIMITED = Kind("rate-limited", 429, "This client asks too often")
HEAD_TOO_LARGE = Kind("headers-too-large", 431, "The headers are too large")
INTERNAL = Kind("internal", 500, "The service failed")
NOT_READY = Kind("not-ready", 503, "The service is not ready")
OVERLOADED = Kind("overloaded", 503, "The service has too much to do")
TOO_MANY_CONNECTIONS = Kind("too-many-connections", 503, "The service has too many connections")
SUPERSEDED = Kind("superseded", 503, "A newer frame of the stream took this one's place")
DEADLINE_PASSED = Kind("deadline-passed", 503, "The frame's deadline passed before its turn came")

KINDS = (
    MALFORMED,
    UNAUTHORIZED,
    FORBIDDEN_ORIGIN,
    NOT_FOUND,
    METHOD_NOT_ALLOWED,
    NOT_ACCEPTABLE,
    TOO_SLOW,
    BODY_TOO_LARGE,
    UNSUPPORTED_TYPE,
    INVALID_REQUEST,
    NOT_AN_IMAGE,
    DAMAGED_IMAGE,
    UNSUPPORTED_IMAGE,
    TRAILING_BYTES,
    IMAGE_SIZE,
    IMAGE_ASPECT,
    FIELD_OF_VIEW,
    RATE_LIMITED,
    HEAD_TOO_LARGE,
    INTERNAL,
    NOT_READY,
    OVERLOADED,
    TOO_MANY_CONNECTIONS,
    SUPERSEDED,
    DEADLINE_PASSED,
)
IMAGE_KINDS = {
    Fault.NOT_AN_IMAGE: NOT_AN_IMAGE,
    Fault.DAMAGED: DAMAGED_IMAGE,
    Fault.UNSUPPORTED: UNSUPPORTED_IMAGE,
    Fault.SIZE: IMAGE_SIZE,
    Fault.ASPECT: IMAGE_ASPECT,
    Fault.FIELD_OF_VIEW: FIELD_OF_VIEW,
    Fault.TRAILING: TRAILING_BYTES,
}
# What a client of this service can do about it, beside what the image's reader says.
HINTS = {
    NOT_AN_IMAGE: "; post the bytes of the file itself",
    IMAGE_SIZE: " (GET /model)",
    IMAGE_ASPECT: " (GET /model says how it is mounted)",
    FIELD_OF_VIEW: " (GET /model says how the model's is mounted)",
}
RETRY_AFTER_MS = 1000  # where nothing better is known


class Problem(UserError):
    """A request that gets no answer, and why; `retry_after_ms` says when to ask again."""

    def __init__(self, kind: Kind, detail: str, retry_after_ms: float | None = None) -> None:
        super().__init__(detail)
        self.kind = kind
        self.detail = detail
        if retry_after_ms is None and kind.status in (429, 503):
            retry_after_ms = RETRY_AFTER_MS
        self.retry_after_ms = None if retry_after_ms is None else max(1, round(retry_after_ms))

    @property
    def content(self) -> dict[str, Any]:
        """The problem's members, `retry_after_ms` in milliseconds among them where it is known."""
        content = members(self.kind.type, self.kind.title, self.kind.status, self.detail)
        if self.retry_after_ms is not None:
            content["retry_after_ms"] = self.retry_after_ms
        return content

    @property
    def headers(self) -> dict[str, str]:
        """The headers that go with it."""
        headers = {"WWW-Authenticate": "Bearer"} if self.kind is UNAUTHORIZED else {}
        if self.retry_after_ms is not None:  # whole seconds, the header's unit
            headers["Retry-After"] = str(max(1, ceil(self.retry_after_ms / 1e3)))
        return headers


def image_problem(error: ImageError) -> Problem:
    """The problem that an unreadable image is here."""
    kind = IMAGE_KINDS[error.fault]
    return Problem(kind, f"{error}{HINTS.get(kind, '')}")


def failure() -> Problem:
    """The problem that a fault of ours is to a client, who gets nothing of our insides."""
    return Problem(INTERNAL, "the request could not be answered; the service's log says why")


def members(type_uri: str, title: str, status: int, detail: str) -> dict[str, Any]:
    """The members that every problem has."""
    return {"type": type_uri, "title": title, "status": status, "detail": detail}
