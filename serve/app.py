"""The service as one ASGI application. It handles POST /features and /stream; FastAPI handles the
other paths."""

import time
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from dataclasses import asdict
from functools import partial
from importlib.metadata import version
from typing import TYPE_CHECKING, Any

from fastapi import FastAPI
from fastapi.responses import JSONResponse, PlainTextResponse, Response
from starlette.routing import Route

from mtlnet.inference.engine import Engine, int8_files, view_count
from runtime.processor import usable_cores
from serve import problems
from serve.api import kserve, schemas
from serve.api.access import PROBES, Access
from serve.api.console import add_console
from serve.api.features import FeaturesRequest, FrameHandler
from serve.api.features_asgi import FeaturesEndpoint
from serve.api.problem_handlers import install_problem_handlers
from serve.api.stream import Stream
from serve.asgi import App, Receive, Scope, Send, send_reply, without_body
from serve.cameras import NO_CAMERAS, Cameras
from serve.config import Limits
from serve.observability.logs import RefusalLog
from serve.observability.metrics import MEDIA_TYPE, Metrics
from serve.scheduling.body_budget import BodyBudget
from serve.scheduling.frame_queue import FrameQueue
from serve.scheduling.rate_limit import RateLimiter
from serve.scheduling.streams import StreamTable
from serve.scheduling.warmup import warm_up
from serve.shared_memory import SharedMemory, create_shared_memory
from trackfeatures.camera import stored

if TYPE_CHECKING:
    from opentelemetry.trace import Tracer

    from serve.observability.tracing import RequestTracer

DESCRIPTION = "One driver-view image in, track features out. Angles in rad, distances in m."


class Service:
    """The ASGI application of one worker, which answers images with one engine."""

    def __init__(
        self,
        engine: Engine,
        check: Callable[[Engine], None] = warm_up,
        limits: Limits | None = None,
        shared: SharedMemory | None = None,
        block: int = 0,
        tracer: "Tracer | None" = None,
        cameras: Cameras = NO_CAMERAS,
    ) -> None:
        """`check` warms up the engine and raises an error if its outputs are wrong. It runs when
        the application starts (ASGI lifespan); until it returns, /readyz and /features answer 503.

        `shared` is the workers' shared memory (None for a single worker), and `block` the number of
        this worker's block in it. `cameras` are the cameras that requests can name. Without
        `tracer` no traces are recorded.
        """
        self.limits = limits or Limits()
        self.shared = shared or create_shared_memory(1)
        streams = StreamTable(self.shared.streams())
        workers = self.shared.workers
        self.frame_queue = FrameQueue(
            engine, check, streams, self.limits.queue, usable_cores() < 2 * workers, cameras
        )
        self.metrics = Metrics(self.shared, block)
        self.bodies = BodyBudget(self.shared, block, self.limits.body_mib << 20)
        self.frames = FrameHandler(
            self.frame_queue,
            self.metrics,
            self.bodies,
            RefusalLog(workers),
            self.limits.log_answers,
            None if tracer is None else _request_tracer(tracer),
        )
        self.make_request = partial(FeaturesRequest, self.frames)
        self.features = FeaturesEndpoint(self.frames)
        self.rate_limiter = RateLimiter(self.shared.clients(), self.limits.rate)
        self.access = Access(self.limits, self.rate_limiter, self.frames.count_refusal)
        self.framework = _framework(self)
        self._framework_app: App = self.framework
        self._stream: App = Stream(self.frames, self.rate_limiter)
        if self.frames.tracer is not None:
            self._framework_app = self.frames.tracer.traced(self.framework, kserve.INFER_PATHS)
            self._stream = self.frames.tracer.traced(self._stream, kserve.INFER_PATHS)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] == "lifespan":
            await self.framework(scope, receive, send)
            return
        protocol = "http" if scope["type"] == "http" else "websocket.http"
        if scope.get("method") == "HEAD":
            scope, send = {**scope, "method": "GET"}, without_body(send)
        refusal = self.access.scope_refusal(scope)
        if refusal is not None:
            await send_reply(send, refusal, protocol)
            return
        if scope["type"] == "websocket":
            await self._stream(scope, receive, send)
        elif scope["path"] == "/features" and scope["method"] == "POST":
            await self.features(scope, receive, send)
        else:
            await self._framework_app(scope, receive, send)


def _request_tracer(tracer: "Tracer") -> "RequestTracer":
    from serve.observability.tracing import RequestTracer  # needs the extra `telemetry`

    return RequestTracer(tracer)


def _framework(service: Service) -> FastAPI:
    @asynccontextmanager
    async def lifespan(_app: FastAPI) -> AsyncIterator[None]:
        service.frame_queue.start()
        yield
        service.frame_queue.close()

    app = FastAPI(
        title="driverview",
        version=version("driverview"),
        description=DESCRIPTION,
        lifespan=lifespan,
        redirect_slashes=False,
        docs_url=None,  # FastAPI's own page loads its scripts from the internet
        redoc_url=None,
    )
    install_problem_handlers(app)
    schemas.install_openapi(app, PROBES, token_required=service.limits.token is not None)
    # POST never arrives here; other methods get 405 with the allowed method.
    app.router.routes.append(Route("/features", service.features, methods=["POST"]))
    _add_status(app, service.frames)
    _add_metrics(app, service)
    kserve.add_kserve(app, service.frames)
    add_console(app)
    return app


def _add_status(app: FastAPI, frames: FrameHandler) -> None:
    frame_queue = frames.queue

    @app.get("/healthz", summary="Is the process alive?", response_model=schemas.Status)
    async def healthz() -> Response:
        return JSONResponse({"status": "alive"})

    @app.get(
        "/readyz",
        summary="Is the model warm, and did it pass its check?",
        response_model=schemas.Status,
        responses=schemas.problem_responses(problems.NOT_READY),
    )
    async def readyz() -> Response:
        frame_queue.check_ready()
        model = frame_queue.loaded.provenance["model"]
        return JSONResponse({"status": "ready", "model": model})

    @app.get("/model", summary="The model card: training, data and camera")
    async def model() -> dict[str, Any]:
        loaded = frame_queue.loaded
        card = asdict(loaded.engine.card, dict_factory=stored)
        known = {name: camera.as_dict() for name, camera in loaded.cameras.items()}
        engine = {"views": view_count(loaded.engine), "int8_files": int8_files(loaded.engine)}
        return {**loaded.provenance, **card, **engine, "cameras": known}


def _add_metrics(app: FastAPI, service: Service) -> None:
    @app.get(
        "/metrics",
        summary="Counts and times of all workers, for Prometheus",
        response_class=PlainTextResponse,
    )
    async def metrics() -> Response:
        provenance = service.frame_queue.loaded.provenance
        page = service.metrics.page(time.monotonic(), provenance)
        return Response(page, media_type=MEDIA_TYPE)
