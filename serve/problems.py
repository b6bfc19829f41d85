"""What the service says when it cannot answer: RFC 9457 problems, each kind with a stable type.

A problem's `type` names its kind and never changes; `detail` says what was seen and what to do.
"""

import http
import json
from dataclasses import dataclass
from typing import Any

from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect
from starlette.responses import Response

from mtlnet.image_error import Fault, ImageError
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


INVALID_REQUEST = Kind("invalid-request", 422, "The request is not understood")
BODY_TOO_LARGE = Kind("body-too-large", 413, "The body is too large")
UNSUPPORTED_TYPE = Kind("unsupported-media-type", 415, "The body has another type than an image")
NOT_AN_IMAGE = Kind("not-an-image", 422, "The body is no JPEG or PNG image")
DAMAGED_IMAGE = Kind("damaged-image", 422, "The image is damaged or incomplete")
UNSUPPORTED_IMAGE = Kind("unsupported-image", 422, "The image has a coding that is not supported")
IMAGE_SIZE = Kind("image-size", 422, "The image is too small or too large")
IMAGE_ASPECT = Kind("image-aspect", 422, "The image has another shape than the model's camera")
NOT_READY = Kind("not-ready", 503, "The service is not ready")
OVERLOADED = Kind("overloaded", 503, "The service has too much to do")
NOT_FOUND = Kind("not-found", 404, "There is nothing at this path")
METHOD_NOT_ALLOWED = Kind("method-not-allowed", 405, "This path does not take this method")
INTERNAL = Kind("internal", 500, "The service failed")

KINDS = (
    INVALID_REQUEST,
    BODY_TOO_LARGE,
    UNSUPPORTED_TYPE,
    NOT_AN_IMAGE,
    DAMAGED_IMAGE,
    UNSUPPORTED_IMAGE,
    IMAGE_SIZE,
    IMAGE_ASPECT,
    NOT_READY,
    OVERLOADED,
    NOT_FOUND,
    METHOD_NOT_ALLOWED,
    INTERNAL,
)
IMAGE_KINDS = {
    Fault.NOT_AN_IMAGE: NOT_AN_IMAGE,
    Fault.DAMAGED: DAMAGED_IMAGE,
    Fault.UNSUPPORTED: UNSUPPORTED_IMAGE,
    Fault.SIZE: IMAGE_SIZE,
    Fault.ASPECT: IMAGE_ASPECT,
}
# What a client of this service can do about it, beside what the image's reader says.
HINTS = {
    NOT_AN_IMAGE: "; post the bytes of the file itself",
    IMAGE_SIZE: " (GET /model)",
    IMAGE_ASPECT: " (GET /model says how it is mounted)",
}
RETRY_AFTER = {"Retry-After": "1"}  # whole seconds, the header's unit


class Problem(UserError):
    """A request that gets no answer, and why."""

    def __init__(self, kind: Kind, detail: str) -> None:
        super().__init__(detail)
        self.kind = kind
        self.detail = detail


def image_problem(error: ImageError) -> Problem:
    """The problem that an unreadable image is here."""
    kind = IMAGE_KINDS[error.fault]
    return Problem(kind, f"{error}{HINTS.get(kind, '')}")


def respond(kind: Kind, detail: str, headers: dict[str, str] | None = None) -> Response:
    """The problem as a response."""
    return _response(kind.type, kind.status, kind.title, detail, headers)


def _response(
    type_uri: str, status: int, title: str, detail: str, headers: dict[str, str] | None
) -> Response:
    content: dict[str, Any] = {"type": type_uri, "title": title, "status": status, "detail": detail}
    return Response(json.dumps(content), status, headers, MEDIA_TYPE)


def install(app: FastAPI) -> None:
    """Make every error that leaves `app` a problem, those of the framework included."""
    app.add_exception_handler(Problem, _on_problem)
    app.add_exception_handler(ImageError, _on_image_error)
    app.add_exception_handler(ClientDisconnect, _on_departure)
    app.add_exception_handler(HTTPException, _on_http_exception)
    app.add_exception_handler(RequestValidationError, _on_validation_error)
    app.add_exception_handler(Exception, _on_failure)


def _on_problem(_request: Request, error: Exception) -> Response:
    assert isinstance(error, Problem)
    headers = RETRY_AFTER if error.kind.status == 503 else None
    return respond(error.kind, error.detail, headers)


def _on_image_error(request: Request, error: Exception) -> Response:
    assert isinstance(error, ImageError)
    return _on_problem(request, image_problem(error))


def _on_departure(_request: Request, _error: Exception) -> Response:
    """A client that left in mid-upload is no failure of the service; nobody reads this answer."""
    return respond(INVALID_REQUEST, "the client left before its image was whole")


def _on_http_exception(request: Request, error: Exception) -> Response:
    assert isinstance(error, HTTPException)
    headers = dict(error.headers or {})
    path = request.url.path
    if error.status_code == 404:
        detail = f"there is nothing at {path}; images go to POST /features, the docs are at /docs"
        return respond(NOT_FOUND, detail, headers)
    if error.status_code == 405:
        allowed = headers.get("allow") or headers.get("Allow") or "another method"
        detail = f"{path} takes {allowed}, not {request.method}; the docs are at /docs"
        return respond(METHOD_NOT_ALLOWED, detail, headers)
    title = http.HTTPStatus(error.status_code).phrase
    return _response("about:blank", error.status_code, title, str(error.detail), headers)


def _on_validation_error(_request: Request, error: Exception) -> Response:
    assert isinstance(error, RequestValidationError)
    seen = "; ".join(f"{'.'.join(map(str, e['loc']))}: {e['msg']}" for e in error.errors())
    return respond(INVALID_REQUEST, f"{seen}; the docs are at /docs")


def _on_failure(_request: Request, _error: Exception) -> Response:
    # The server logs the error itself; a client gets nothing of our insides.
    detail = "the request could not be answered; the service's log says why"
    return respond(
        INTERNAL, detail, {"Connection": "close"}
    )  # the server closes it after a failure
