"""Exception handlers that turn every error of the FastAPI application into a problem."""

import http
import json
from typing import Any

from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from starlette.exceptions import HTTPException
from starlette.responses import Response

from mtlnet.inference.image_decoding.errors import ImageError
from serve.problems import (
    INVALID_REQUEST,
    MEDIA_TYPE,
    METHOD_NOT_ALLOWED,
    NOT_FOUND,
    Problem,
    as_problem,
    internal_error,
    members,
    with_error,
)


def install_problem_handlers(app: FastAPI) -> None:
    """Answer every error raised in `app` with a problem, including the framework's errors."""
    app.add_exception_handler(Problem, _on_expected)
    app.add_exception_handler(ImageError, _on_expected)
    app.add_exception_handler(HTTPException, _on_http_exception)
    app.add_exception_handler(RequestValidationError, _on_validation_error)
    app.add_exception_handler(Exception, _on_unexpected)


def _response(
    request: Request, problem: Problem, headers: dict[str, str] | None = None
) -> Response:
    return _json_response(request, problem.content, {**problem.headers, **(headers or {})})


def _json_response(request: Request, content: dict[str, Any], headers: dict[str, str]) -> Response:
    content = with_error(content, request.url.path)
    return Response(json.dumps(content), content["status"], headers, MEDIA_TYPE)


def _on_expected(request: Request, error: Exception) -> Response:
    assert isinstance(error, Problem | ImageError)
    return _response(request, as_problem(error))


def _on_http_exception(request: Request, error: Exception) -> Response:
    assert isinstance(error, HTTPException)
    headers = {name.title(): value for name, value in (error.headers or {}).items()}
    path = request.url.path
    if error.status_code == 404:
        detail = f"there is nothing at {path}; send images to POST /features, see /docs"
        return _response(request, Problem(NOT_FOUND, detail), headers)
    if error.status_code == 405:
        allowed = set(headers.get("Allow", "").split(", "))
        if "GET" in allowed:
            allowed.add("HEAD")
        methods = headers["Allow"] = ", ".join(sorted(allowed))
        detail = f"{path} accepts {methods}, not {request.method}; see /docs"
        return _response(request, Problem(METHOD_NOT_ALLOWED, detail), headers)
    title = http.HTTPStatus(error.status_code).phrase
    content = members("about:blank", title, error.status_code, str(error.detail))
    return _json_response(request, content, headers)


def _on_validation_error(request: Request, error: Exception) -> Response:
    assert isinstance(error, RequestValidationError)
    seen = "; ".join(f"{'.'.join(map(str, e['loc']))}: {e['msg']}" for e in error.errors())
    return _response(request, Problem(INVALID_REQUEST, f"{seen}; see /docs"))


def _on_unexpected(request: Request, _error: Exception) -> Response:
    # The server logs the error and then closes the connection.
    return _response(request, internal_error(), {"Connection": "close"})
