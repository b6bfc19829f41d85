"""What FastAPI refuses by itself, as problems like all others.

Apart from `serve.api.problems`, so that whoever only names a problem loads no framework: the
supervisor's start would take twice as long.
"""

import http
import json
from typing import Any

from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from starlette.exceptions import HTTPException
from starlette.responses import Response

from mtlnet.inference.image_decoding.errors import ImageError
from serve.api.problems import (
    INVALID_REQUEST,
    MEDIA_TYPE,
    METHOD_NOT_ALLOWED,
    NOT_FOUND,
    Problem,
    failure,
    image_problem,
    members,
)


def respond(problem: Problem, headers: dict[str, str] | None = None) -> Response:
    """The problem as a response."""
    return _response(problem.content, {**problem.headers, **(headers or {})})


def _response(content: dict[str, Any], headers: dict[str, str] | None) -> Response:
    return Response(json.dumps(content), content["status"], headers, MEDIA_TYPE)


def install(app: FastAPI) -> None:
    """Make every error that leaves `app` a problem, those of the framework included."""
    app.add_exception_handler(Problem, _on_problem)
    app.add_exception_handler(ImageError, _on_image_error)
    app.add_exception_handler(HTTPException, _on_http_exception)
    app.add_exception_handler(RequestValidationError, _on_validation_error)
    app.add_exception_handler(Exception, _on_failure)


def _on_problem(_request: Request, error: Exception) -> Response:
    assert isinstance(error, Problem)
    return respond(error)


def _on_image_error(_request: Request, error: Exception) -> Response:
    assert isinstance(error, ImageError)
    return respond(image_problem(error))


def _on_http_exception(request: Request, error: Exception) -> Response:
    assert isinstance(error, HTTPException)
    headers = dict(error.headers or {})
    path = request.url.path
    if error.status_code == 404:
        detail = f"there is nothing at {path}; images go to POST /features, the docs are at /docs"
        return respond(Problem(NOT_FOUND, detail), headers)
    if error.status_code == 405:
        allowed = headers.get("allow") or headers.get("Allow") or "another method"
        detail = f"{path} takes {allowed}, not {request.method}; the docs are at /docs"
        return respond(Problem(METHOD_NOT_ALLOWED, detail), headers)
    title = http.HTTPStatus(error.status_code).phrase
    return _response(members("about:blank", title, error.status_code, str(error.detail)), headers)


def _on_validation_error(_request: Request, error: Exception) -> Response:
    assert isinstance(error, RequestValidationError)
    seen = "; ".join(f"{'.'.join(map(str, e['loc']))}: {e['msg']}" for e in error.errors())
    return respond(Problem(INVALID_REQUEST, f"{seen}; the docs are at /docs"))


def _on_failure(_request: Request, _error: Exception) -> Response:
    # The server logs the error itself, and closes the connection after a failure.
    return respond(failure(), {"Connection": "close"})
