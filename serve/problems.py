"""Error answers of the service: RFC 9457 problems.

The `type` of a problem never changes; `detail` has what was seen, what was expected, and what to
do. Below /v2 a problem also has the member `error`, which the Open Inference Protocol requires.
"""

from dataclasses import dataclass
from math import ceil
from typing import Any

from mtlnet.inference.image_decoding.errors import Fault, ImageError
from serve.config import MAX_BODY_BYTES, MAX_HEAD_BYTES
from trackfeatures.errors import UserError

MEDIA_TYPE = "application/problem+json"


@dataclass(frozen=True, slots=True, eq=False)  # compared by identity
class ProblemType:
    """A type of problem: its name (the last part of the type URI), HTTP status and title."""

    name: str
    status: int
    title: str

    @property
    def uri(self) -> str:
        """The type URI, relative to the service's address."""
        return f"/problems/{self.name}"


MALFORMED = ProblemType("malformed-request", 400, "This is not an HTTP request")
UNAUTHORIZED = ProblemType("unauthorized", 401, "The token is missing or wrong")
FORBIDDEN_ORIGIN = ProblemType(
    "forbidden-origin", 403, "Pages of other sites may not use this service"
)
FORBIDDEN_HOST = ProblemType(
    "forbidden-host", 403, "Without a token only the service's own host names are accepted"
)
NOT_FOUND = ProblemType("not-found", 404, "There is nothing at this path")
METHOD_NOT_ALLOWED = ProblemType("method-not-allowed", 405, "This path does not accept this method")
NOT_ACCEPTABLE = ProblemType(
    "not-acceptable", 406, "The answer is not available in the accepted types"
)
TOO_SLOW = ProblemType("request-timeout", 408, "The request was sent too slowly")
BODY_TOO_LARGE = ProblemType("body-too-large", 413, "The body is too large")
UNSUPPORTED_TYPE = ProblemType(
    "unsupported-media-type", 415, "The body is not declared as an image"
)
INVALID_REQUEST = ProblemType("invalid-request", 422, "The request is not valid")
NOT_AN_IMAGE = ProblemType("not-an-image", 422, "The body is not a JPEG or PNG image")
DAMAGED_IMAGE = ProblemType("damaged-image", 422, "The image is damaged or incomplete")
UNSUPPORTED_IMAGE = ProblemType("unsupported-image", 422, "The image uses an unsupported coding")
TRAILING_BYTES = ProblemType("trailing-bytes", 422, "The body contains more than the image")
IMAGE_SIZE = ProblemType("image-size", 422, "The image is too small or too large")
IMAGE_ASPECT = ProblemType(
    "image-aspect", 422, "The image has another aspect ratio than the model's camera"
)
FIELD_OF_VIEW = ProblemType("field-of-view", 422, "The image shows less than the model's camera")
RATE_LIMITED = ProblemType("rate-limited", 429, "This client sends too many requests")
HEAD_TOO_LARGE = ProblemType("headers-too-large", 431, "The headers are too large")
INTERNAL = ProblemType("internal", 500, "The service failed")
NOT_READY = ProblemType("not-ready", 503, "The service is not ready")
OVERLOADED = ProblemType("overloaded", 503, "The service is overloaded")
TOO_MANY_CONNECTIONS = ProblemType(
    "too-many-connections", 503, "The service has too many connections"
)
SUPERSEDED = ProblemType("superseded", 503, "A newer frame of the stream replaced this one")
DEADLINE_PASSED = ProblemType(
    "deadline-passed", 503, "The deadline passed before the frame was processed"
)

# In the order of the definitions above. The counters in shared memory have the same order.
PROBLEM_TYPES = tuple(found for found in vars().values() if isinstance(found, ProblemType))
IMAGE_PROBLEMS = {
    Fault.NOT_AN_IMAGE: NOT_AN_IMAGE,
    Fault.DAMAGED: DAMAGED_IMAGE,
    Fault.UNSUPPORTED: UNSUPPORTED_IMAGE,
    Fault.SIZE: IMAGE_SIZE,
    Fault.ASPECT: IMAGE_ASPECT,
    Fault.FIELD_OF_VIEW: FIELD_OF_VIEW,
    Fault.TRAILING: TRAILING_BYTES,
}
# Advice for clients of this service, appended to the image decoder's message.
HINTS = {
    NOT_AN_IMAGE: "; post the bytes of the file itself",
    IMAGE_SIZE: " (GET /model has the model's camera)",
    IMAGE_ASPECT: " (GET /model has the mount of the model's camera)",
    FIELD_OF_VIEW: " (GET /model has the mount of the model's camera)",
}
RETRY_AFTER_MS = 1000  # used without a better estimate


class Problem(UserError):
    """A request that cannot be answered; `retry_after_ms` is the time until a retry in ms."""

    def __init__(
        self, problem_type: ProblemType, detail: str, retry_after_ms: float | None = None
    ) -> None:
        super().__init__(detail)
        self.type = problem_type
        self.detail = detail
        if retry_after_ms is None and problem_type.status in (429, 503):
            retry_after_ms = RETRY_AFTER_MS
        self.retry_after_ms = None if retry_after_ms is None else max(1, round(retry_after_ms))

    @property
    def content(self) -> dict[str, Any]:
        """The members of the JSON object; `retry_after_ms` only if it is known."""
        content = members(self.type.uri, self.type.title, self.type.status, self.detail)
        if self.retry_after_ms is not None:
            content["retry_after_ms"] = self.retry_after_ms
        return content

    @property
    def headers(self) -> dict[str, str]:
        """The HTTP headers of this problem."""
        headers = {"WWW-Authenticate": "Bearer"} if self.type is UNAUTHORIZED else {}
        if self.retry_after_ms is not None:  # the header's unit is whole seconds
            headers["Retry-After"] = str(max(1, ceil(self.retry_after_ms / 1e3)))
        return headers


def as_problem(error: Problem | ImageError) -> Problem:
    """Return the problem for an image that cannot be decoded; return a Problem unchanged."""
    if isinstance(error, Problem):
        return error
    problem_type = IMAGE_PROBLEMS[error.fault]
    return Problem(problem_type, f"{error}{HINTS.get(problem_type, '')}")


def forget_frames(error: BaseException) -> None:
    """Drop the tracebacks of `error` and of its causes. The stack frames in a traceback can
    reference the body of the request and `error` itself, and this cycle would keep the body in
    memory."""
    found: BaseException | None = error
    while found is not None:
        found.__traceback__ = None
        found = found.__cause__ or found.__context__


def internal_error() -> Problem:
    """Make the problem for an unexpected exception, without the text of the exception."""
    return Problem(INTERNAL, "the request could not be answered; see the service's log")


def body_too_large(seen: str) -> Problem:
    """Make the problem for a body that is too large; `seen` describes its size."""
    return Problem(
        BODY_TOO_LARGE,
        f"the body has {seen}; the limit is {MAX_BODY_BYTES}: send a smaller image or "
        "compress it more",
    )


def head_too_large() -> Problem:
    """Make the problem for headers or trailers above the size limit."""
    return Problem(HEAD_TOO_LARGE, f"the headers have more than {MAX_HEAD_BYTES} bytes; send fewer")


def stopping() -> Problem:
    """Make the problem for a request that arrives while the service stops."""
    return Problem(NOT_READY, "the service stops or restarts; try again on a new connection")


def small_chunks(size: int) -> Problem:
    """Make the problem for a body in hundreds of chunks that are smaller than `size` bytes."""
    return Problem(
        BODY_TOO_LARGE, f"the body has many chunks of less than {size} bytes; send larger ones"
    )


def too_many_requests(what: str) -> Problem:
    """Make the problem for requests sent without waiting for earlier replies; `what` is the
    exceeded limit, such as "16 requests"."""
    return Problem(RATE_LIMITED, f"more than {what} arrived at once; wait for the replies")


def too_slow(part: str, limit_s: float) -> Problem:
    """Make the problem for a part of a request ("headers", "body") not complete after `limit_s`."""
    return Problem(TOO_SLOW, f"the {part} did not arrive within {limit_s:g} s")


def members(type_uri: str, title: str, status: int, detail: str) -> dict[str, Any]:
    """Return the members that every problem has, by name."""
    return {"type": type_uri, "title": title, "status": status, "detail": detail}


def with_error(content: dict[str, Any], path: str) -> dict[str, Any]:
    """Return `content`, the members of a problem; for a `path` below /v2 also with the member
    `error`, which the Open Inference Protocol requires."""
    if path == "/v2" or path.startswith(("/v2/", "/v2?")):
        return {**content, "error": content["detail"]}
    return content
