"""The HTTP application: POST /features with an image, and what tells how the service is."""

import json
import time
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from dataclasses import asdict
from importlib.metadata import version
from pathlib import Path
from typing import Any

from fastapi import FastAPI, Request
from fastapi.responses import HTMLResponse, JSONResponse, Response

import trackfeatures as tf
from mtlnet.engine import Engine
from mtlnet.images import inspect
from serve import contract, problems
from serve.gate import check_headers, read_body
from serve.perceiver import Perceived, Perceiver
from serve.problems import Problem
from serve.readiness import warm_up

PAGE = Path(__file__).parent / "index.html"
DESCRIPTION = "One driver-view image in, track features out. Angles in rad, distances in m."
REFUSALS = (
    problems.BODY_TOO_LARGE,
    problems.UNSUPPORTED_TYPE,
    problems.NOT_AN_IMAGE,
    problems.DAMAGED_IMAGE,
    problems.UNSUPPORTED_IMAGE,
    problems.IMAGE_SIZE,
    problems.IMAGE_ASPECT,
    problems.INVALID_REQUEST,
    problems.INTERNAL,
    problems.NOT_READY,
    problems.OVERLOADED,
)


def create_app(engine: Engine, check: Callable[[Engine], None] = warm_up) -> FastAPI:
    """The service around `engine`; `check` warms it up and raises when its answers are wrong.

    The check runs when the application starts (its lifespan): until it is through, /readyz and
    /features answer 503.
    """
    perceiver = Perceiver(engine, check)

    @asynccontextmanager
    async def lifespan(_app: FastAPI) -> AsyncIterator[None]:
        perceiver.start()
        yield
        perceiver.close()

    app = FastAPI(
        title="driverview",
        version=version("driverview"),
        description=DESCRIPTION,
        lifespan=lifespan,
        redirect_slashes=False,
    )
    problems.install(app)
    contract.install_openapi(app)
    _add_features(app, perceiver)
    _add_status(app, perceiver)
    return app


def _add_features(app: FastAPI, perceiver: Perceiver) -> None:
    engine = perceiver.engine
    origin = {
        "model": engine.card.model_hash,
        "definitions_version": tf.VERSION,
        "engine": engine.kind,
        "precision": engine.precision,
    }

    @app.post(
        "/features",
        summary="Track features of one driver-view image",
        response_model=contract.Features,
        responses=contract.problem_responses(*REFUSALS),
        openapi_extra=contract.IMAGE_REQUEST,
    )
    async def features(request: Request) -> Response:
        start = time.perf_counter()
        frame_id = _frame_id(request)
        check_headers(request.headers)
        body = await read_body(request.stream())
        header = inspect(body, engine.card.camera)
        perceived = await perceiver.perceive(body, header)
        total_ms = 1e3 * (time.perf_counter() - start)
        # Not through the response model: it was validated by the tests, once for all requests.
        content = {
            **perceived.answer.as_json(),
            **origin,
            "timing_ms": _timing(perceived, total_ms),
            "frame_id": frame_id,
        }
        return Response(json.dumps(content), media_type="application/json")


def _add_status(app: FastAPI, perceiver: Perceiver) -> None:
    engine = perceiver.engine
    card = engine.card

    @app.get("/healthz", summary="Is the process alive?", response_model=contract.Status)
    async def healthz() -> Response:
        return JSONResponse({"status": "alive"})

    @app.get(
        "/readyz",
        summary="Is the model warm, and did it give its golden answer?",
        response_model=contract.Status,
        responses=contract.problem_responses(problems.NOT_READY),
    )
    async def readyz() -> Response:
        perceiver.check_ready()
        return JSONResponse({"status": "ready", "model": card.model_hash})

    @app.get("/model", summary="What the model was made from, and for which camera")
    async def model() -> dict[str, Any]:
        return {
            "model": card.model_hash,
            "engine": engine.kind,
            "precision": engine.precision,
            **asdict(card),
        }

    @app.get("/", include_in_schema=False)
    async def page() -> HTMLResponse:
        return HTMLResponse(PAGE.read_text(encoding="utf-8"))


def _frame_id(request: Request) -> str | None:
    sent = request.headers.get(contract.FRAME_ID)
    if sent is None:
        return None
    if len(sent) > contract.MAX_FRAME_ID or not (sent.isascii() and sent.isprintable()):
        raise Problem(
            problems.INVALID_REQUEST,
            f"{contract.FRAME_ID} has {len(sent)} characters; at most {contract.MAX_FRAME_ID} of "
            "printable ASCII are taken",
        )
    return sent


def _timing(perceived: Perceived, total_ms: float) -> dict[str, float]:
    return {
        "decode": round(perceived.decode_ms, 3),
        "forward": round(perceived.forward_ms, 3),
        "total": round(total_ms, 3),
    }
