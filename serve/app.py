"""The service as one application: frames by hand, all else by FastAPI."""

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
from serve.api import failures, problems
from serve.api import kserve as inference
from serve.api import schemas as contract
from serve.api.console import add_console
from serve.api.docs import PATH as DOCS
from serve.api.docs import add_docs
from serve.api.features import FeaturesEndpoint, FeaturesRequest, FrameHandler, client_of
from serve.api.http_io import Receive, Reply, Scope, Send, refusal, reply
from serve.api.problems import Problem
from serve.api.request_options import Headers, check_token
from serve.api.stream import Stream
from serve.config import Limits
from serve.observability.metrics import MEDIA_TYPE, Metrics
from serve.scheduling.frame_queue import FrameQueue
from serve.scheduling.rate_limit import Rate
from serve.scheduling.streams import Streams
from serve.scheduling.warmup import warm_up
from serve.workers.shared_memory import Shared, create

if TYPE_CHECKING:
    from opentelemetry.trace import Tracer

App = Callable[[Scope, Receive, Send], Awaitable[None]]
Begin = Callable[[FrameHandler, str, Callable[[Reply], None]], FeaturesRequest]

PROBES = {
    "/healthz",
    "/readyz",
    *inference.PROBES,
}  # what a balancer asks, often and without a token
DESCRIPTION = "One driver-view image in, track features out. Angles in rad, distances in m."


class Service:
    """The ASGI application around one engine."""

    def __init__(
        self,
        engine: Engine,
        check: Callable[[Engine], None] = warm_up,
        limits: Limits | None = None,
        shared: Shared | None = None,
        slot: int = 0,
        tracer: "Tracer | None" = None,
    ) -> None:
        """`check` warms an engine up and raises when its answers are wrong.

        It runs when the application starts (its lifespan): until it is through, /readyz and
        /features answer 503. `shared` None: this is the only worker; else `slot` is its block.
        `tracer` None: nothing is traced.
        """
        self.limits = limits or Limits()
        self.shared = shared or create(slots=1)
        streams = Streams(self.shared.streams())
        self.perceiver = FrameQueue(engine, check, streams, self.limits.queue)
        self.metrics = Metrics(self.shared, slot)
        self.sight = FrameHandler(self.perceiver, self.metrics, self.limits.log_answers)
        self._begin: Begin = FeaturesRequest
        if tracer is not None:
            self.sight, self._begin = _traced(self, tracer)
        self.features = FeaturesEndpoint(self.sight, self._begin)
        self.rate = Rate(self.shared.clients(), self.limits.rate)
        self._token = self.limits.token
        self._stream: App = Stream(self.sight, self.rate)
        self.framework = _framework(self)
        self._other: App = self.framework
        if tracer is not None:
            self._stream, self._other = _traced_apps(tracer, self._stream, self._other)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] == "lifespan":
            await self.framework(scope, receive, send)
            return
        way = "http" if scope["type"] == "http" else "websocket.http"
        if not _is_public(scope["path"]):
            stopped = self._at_the_door(dict(scope["headers"]), client_of(scope))
            if stopped is not None:
                await reply(send, stopped, way)
                return
        if scope["type"] == "websocket":
            await self._stream(scope, receive, send)
        elif scope["path"] == "/features" and scope["method"] == "POST":
            await self.features(scope, receive, send)
        else:
            await self._other(scope, receive, send)

    def open(
        self, headers: Headers, client: str, send: Callable[[Reply], None]
    ) -> FeaturesRequest | None:
        """A POST /features whose body is wanted; None: it was replied to."""
        stopped = self._at_the_door(headers, client)
        if stopped is not None:
            send(stopped)
            return None
        exchange = self._begin(self.sight, client, send)
        return exchange if exchange.open(headers) else None

    def _at_the_door(self, headers: Headers, client: str) -> Reply | None:
        """The reply to a client who may not come in."""
        try:
            self.rate.check(client)
            check_token(headers, self._token)
        except Problem as problem:
            self.metrics.refused(problem.kind, self.perceiver.waiting)
            return refusal(problem)
        return None


def _traced(service: Service, tracer: "Tracer") -> tuple[FrameHandler, Begin]:
    from serve.observability.tracing import TracedExchange, TracedSight

    about = (service.perceiver, service.metrics, service.limits.log_answers)
    return TracedSight(tracer, *about), partial(TracedExchange, tracer)


def _traced_apps(tracer: "Tracer", *apps: App) -> list[App]:
    from serve.observability.tracing import Traced

    return [Traced(tracer, app) for app in apps]


def _is_public(path: str) -> bool:
    """Whether a path needs no token: probes, the console's own files, which ask for one, docs."""
    return path in PROBES or path in ("/", DOCS) or path.startswith("/console/")


def _framework(service: Service) -> FastAPI:
    @asynccontextmanager
    async def lifespan(_app: FastAPI) -> AsyncIterator[None]:
        service.perceiver.start()
        yield
        service.perceiver.close()

    app = FastAPI(
        title="driverview",
        version=version("driverview"),
        description=DESCRIPTION,
        lifespan=lifespan,
        redirect_slashes=False,
        docs_url=None,  # the framework's own pages load their scripts from elsewhere
        redoc_url=None,
    )
    failures.install(app)
    contract.install_openapi(app, PROBES)
    # Reached only with another method than POST: who sends one is told which there is.
    app.router.routes.append(Route("/features", service.features, methods=["POST"]))
    _add_status(app, service.perceiver)
    _add_metrics(app, service)
    inference.install(app, service.sight)
    add_console(app)
    add_docs(app)
    return app


def _add_status(app: FastAPI, perceiver: FrameQueue) -> None:
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
        return JSONResponse({"status": "ready", "model": perceiver.loaded.origin["model"]})

    @app.get("/model", summary="What the model was made from, and for which camera")
    async def model() -> dict[str, Any]:
        loaded = perceiver.loaded
        return {**loaded.origin, **asdict(loaded.engine.card)}


def _add_metrics(app: FastAPI, service: Service) -> None:
    @app.get(
        "/metrics",
        summary="Counts and times of all workers, for Prometheus",
        response_class=PlainTextResponse,
    )
    async def metrics() -> Response:
        origin = service.perceiver.loaded.origin
        return Response(service.metrics.page(time.monotonic(), origin), media_type=MEDIA_TYPE)
