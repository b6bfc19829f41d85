"""The service as one ASGI application. It handles POST /features and /stream; FastAPI handles the
other paths."""

import os
import time
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager
from dataclasses import asdict
from functools import partial
from importlib.metadata import version
from typing import TYPE_CHECKING, Any

from fastapi import FastAPI
from fastapi.responses import JSONResponse, PlainTextResponse, Response
from starlette.routing import Route

from mtlnet.inference.engine import Engine
from serve.api import kserve, problems, schemas
from serve.api.console import DOCS_PATH, add_console
from serve.api.features import (
    FeaturesEndpoint,
    FeaturesRequest,
    FrameHandler,
    RequestFactory,
    client_address,
)
from serve.api.hosts import HostCheck
from serve.api.http_io import (
    Receive,
    Reply,
    Scope,
    Send,
    problem_reply,
    send_reply,
    without_body,
)
from serve.api.problem_handlers import install_problem_handlers
from serve.api.problems import Problem
from serve.api.request_options import Headers, check_token, request_id_of
from serve.api.stream import Stream
from serve.cameras import Cameras
from serve.config import Limits
from serve.observability.logs import RefusalLog
from serve.observability.metrics import MEDIA_TYPE, Metrics
from serve.scheduling.body_budget import BodyBudget
from serve.scheduling.frame_queue import FrameQueue
from serve.scheduling.rate_limit import RateLimiter
from serve.scheduling.streams import StreamTable
from serve.scheduling.warmup import warm_up
from serve.workers.shared_memory import SharedMemory, create_shared_memory
from trackfeatures.camera import stored

if TYPE_CHECKING:
    from opentelemetry.trace import Tracer

App = Callable[[Scope, Receive, Send], Awaitable[None]]

PROBES = {"/healthz", "/readyz", *kserve.PROBES}  # load balancers need no token for these
NO_CAMERAS: Cameras = {}
DESCRIPTION = "One driver-view image in, track features out. Angles in rad, distances in m."


class Service:
    """The ASGI application around one engine."""

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

        `shared` is the workers' shared memory and `block` this worker's block in it; None for a
        single worker. `cameras` are the cameras that requests can name. Without `tracer` no traces
        are recorded.
        """
        self.limits = limits or Limits()
        self.shared = shared or create_shared_memory(1)
        streams = StreamTable(self.shared.streams())
        workers = self.shared.workers
        self.frame_queue = FrameQueue(
            engine, check, streams, self.limits.queue, single_core=_cores() < 2 * workers
        )
        self.metrics = Metrics(self.shared, block)
        self.bodies = BodyBudget(self.shared, block, self.limits.body_mib << 20)
        refusals, log_answers = RefusalLog(workers), self.limits.log_answers
        parts = (self.frame_queue, self.metrics, self.bodies, refusals, log_answers, cameras)
        self.frames = FrameHandler(*parts)
        self._make_request: RequestFactory = FeaturesRequest
        if tracer is not None:
            self.frames, self._make_request = _traced(tracer, parts)
        self.features = FeaturesEndpoint(self.frames, self._make_request)
        self.rate_limiter = RateLimiter(self.shared.clients(), self.limits.rate)
        self._hosts = HostCheck(self.limits)
        self._token = self.limits.token
        self._stream: App = Stream(self.frames, self.rate_limiter)
        self.framework = _framework(self)
        self._framework_app: App = self.framework
        if tracer is not None:
            self._stream, self._framework_app = _traced_apps(
                tracer, self._stream, self._framework_app
            )

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] == "lifespan":
            await self.framework(scope, receive, send)
            return
        protocol = "http" if scope["type"] == "http" else "websocket.http"
        if scope.get("method") == "HEAD":
            scope, send = {**scope, "method": "GET"}, without_body(send)
        refusal = self._authorize_scope(scope)
        if refusal is not None:
            await send_reply(send, refusal, protocol)
            return
        if scope["type"] == "websocket":
            await self._stream(scope, receive, send)
        elif scope["path"] == "/features" and scope["method"] == "POST":
            await self.features(scope, receive, send)
        else:
            await self._framework_app(scope, receive, send)

    def open(
        self, headers: Headers, client: str, send: Callable[[Reply], None]
    ) -> FeaturesRequest | None:
        """Begin a POST /features without ASGI. Returns None after a refusal, which is then sent.

        Precondition: no header name occurs twice in the request.
        """
        refusal = self._authorize(headers, client) or self.frames.refuse_early(headers, client)
        if refusal is not None:
            send(refusal)
            return None
        request = self._make_request(self.frames, client, send)
        return request if request.open(headers) else None

    def _authorize(self, headers: Headers, client: str) -> Reply | None:
        """The refusal of a client that exceeds its rate, has a wrong Host or Origin, or lacks the
        token; None for an accepted client."""
        try:
            self.rate_limiter.check(client)
            self._hosts.check(headers)
            check_token(headers, self._token)
        except Problem as problem:
            return self._refuse(problem, headers, client)
        return None

    def _authorize_scope(self, scope: Scope) -> Reply | None:
        """Like `_authorize`, for any path and for headers in which a name can occur twice."""
        path, headers, client = scope["path"], dict(scope["headers"]), client_address(scope)
        try:
            public = _is_public(path)
            self.rate_limiter.check(client, public=public)
            self._hosts.check_single([name for name, _ in scope["headers"]])
            version = scope.get("http_version", "1.1")
            self._hosts.check(headers, probe=path in PROBES, version=version)
            if not public:
                check_token(headers, self._token)
        except Problem as problem:
            return self._refuse(problem, headers, client, path)
        return None

    def _refuse(self, problem: Problem, headers: Headers, client: str, path: str = "") -> Reply:
        self.frames.refusals.log(request_id_of(headers), client, problem)
        self.metrics.count_refusal(problem.type, self.frame_queue.waiting)
        return problem_reply(problem, path=path)


def _traced(tracer: "Tracer", parts: tuple[Any, ...]) -> tuple[FrameHandler, RequestFactory]:
    from serve.observability.tracing import TracedFeaturesRequest, TracedFrameHandler

    return TracedFrameHandler(tracer, *parts), partial(TracedFeaturesRequest, tracer)


def _traced_apps(tracer: "Tracer", *apps: App) -> list[App]:
    from serve.observability.tracing import TracedApp

    return [TracedApp(tracer, app) for app in apps]


def _cores() -> int:
    """The number of cores available to this process."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def _is_public(path: str) -> bool:
    """Whether a path needs no token: probes, docs, and the console, which asks for the token."""
    return path in PROBES or path in ("/", DOCS_PATH) or path.startswith("/console/")


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
        known = {name: camera.as_dict() for name, camera in frames.cameras.items()}
        return {**loaded.provenance, **card, "cameras": known}


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
