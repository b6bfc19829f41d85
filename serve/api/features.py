"""POST /features, from the headers of a request to its reply; `serve.api.schemas` has the JSON.

`serve.server.fast_path` creates a `FeaturesRequest` for each request. `FeaturesEndpoint` does the
same as an ASGI application, for other servers. All endpoints for images use `FrameHandler`.
"""

import asyncio
import logging
import time
from collections.abc import Callable
from functools import partial
from typing import Any

from mtlnet.inference.image_decoding.decode import LATE_CHECK_BYTES, decode_whole, read_header
from mtlnet.inference.image_decoding.errors import ImageError
from serve.api.http_io import (
    ClientDisconnectedError,
    Receive,
    Reply,
    Scope,
    Send,
    check_body_size,
    problem_reply,
    read_body,
    send_reply,
)
from serve.api.problems import INVALID_REQUEST, Problem, as_problem, internal_error
from serve.api.request_options import (
    CAMERA,
    FIELD_OF_VIEW,
    Headers,
    RequestOptions,
    check_image_headers,
    parse_options,
    read_options,
    request_id_of,
)
from serve.cameras import Cameras, Sight
from serve.observability.logs import RefusalLog, log_answer
from serve.observability.metrics import Metrics
from serve.scheduling.body_budget import BodyBudget, BodyShare
from serve.scheduling.fair_queue import Frame, FrameResult, PixelReader, ResultCallback
from serve.scheduling.frame_queue import FrameQueue
from serve.scheduling.streams import stream_key

# Limits of pixels, estimated decoding time in ms and JPEG bytes for decoding on the event loop. The
# estimate depends on a JPEG's pixels only, so its bytes need a limit.
SMALL_PIXELS, SMALL_MS, SMALL_BYTES = 640 * 480, 12.0, LATE_CHECK_BYTES

logger = logging.getLogger(__name__)


class FrameHandler:
    """The handling of a frame for all endpoints: queue it, count its result, log it."""

    def __init__(
        self,
        queue: FrameQueue,
        metrics: Metrics,
        bodies: BodyBudget,
        refusals: RefusalLog,
        log_answers: bool,
        cameras: Cameras,
    ) -> None:
        self.queue = queue
        self.cameras = cameras
        self._bodies = bodies
        self._metrics = metrics
        self.refusals = refusals
        self._log_answers = log_answers

    def share(self) -> BodyShare:
        """The share of a new request in the budget for bodies, initially 0 bytes."""
        return BodyShare(self._bodies)

    def submit(
        self, options: RequestOptions, body: bytes, client: str, on_result: ResultCallback
    ) -> list[int] | None:
        """Queue the image file in `body`; `on_result` is called with its result or an error.

        Returns `crop_px` of the answer. Raises Problem, ImageError.
        """
        self.queue.check_ready()
        if options.stream is None:
            self.queue.check_capacity(client)  # an overloaded worker does not parse images
        camera, sight = self.queue.loaded.engine.card.camera, self.sight(options)
        header = read_header(body)
        sight.check(header.width, header.height, camera)
        read_ms = header.decode_ms
        small = header.width * header.height <= SMALL_PIXELS and read_ms <= SMALL_MS
        small = small and (len(body) <= SMALL_BYTES or header.png_header is not None)
        frame = _frame(
            options,
            client,
            lambda view: sight.through(decode_whole(body, header), view),
            read_ms,
            small,
            sight,
        )
        self.queue.submit(frame, on_result)
        return sight.crop_px(header.width, header.height, camera)

    def sight(self, options: RequestOptions) -> Sight:
        """The camera of a request's image. Raises Problem for an unknown camera."""
        name = options.camera
        if name is None:
            return Sight(options.fov_y_deg)
        if options.fov_y_deg is not None:
            seen = f"{CAMERA} and {FIELD_OF_VIEW} are both given"
            raise Problem(INVALID_REQUEST, f"{seen}; the camera has a field of view, so send one")
        if name not in self.cameras:
            known = ", ".join(self.cameras) or "none (serve --camera NAME=FILE gives it one)"
            raise Problem(INVALID_REQUEST, f"{CAMERA} is {name[:80]!r}; the service knows {known}")
        return Sight(None, self.cameras[name])

    def refuse_early(self, headers: Headers, client: str) -> Reply | None:
        """The refusal of a frame for which the queue has no room, else None.

        It needs only the headers, so that an overloaded worker does little work. A frame of a
        stream is not refused here, since it can replace a queued frame.
        """
        if b"x-stream-id" in headers:
            return None
        problem = self.queue.refusal(client)
        if problem is None:
            return None
        request_id = request_id_of(headers)
        self._count_refusal(problem, request_id, client)
        return problem_reply(problem, (b"x-request-id", request_id.encode()))

    async def predict_file(
        self, options: RequestOptions, body: bytes, client: str
    ) -> dict[str, Any]:
        """The answer for an image file, a `schemas.Features`. Raises Problem, ImageError."""
        future: asyncio.Future[FrameResult] = asyncio.get_running_loop().create_future()
        crop = self.submit(options, body, client, partial(resolve, future))
        del body
        try:
            result = await future
        finally:
            del future  # avoids a cycle: its error's traceback references this frame
        self.record_answer(options, client, result)
        return response_content(options, result, crop)

    async def predict_pixels(
        self, options: RequestOptions, client: str, read: PixelReader, read_ms: float
    ) -> FrameResult:
        """The result for the pixels that `read` returns in about `read_ms`.

        Raises Problem, ImageError.
        """
        future: asyncio.Future[FrameResult] = asyncio.get_running_loop().create_future()
        frame = _frame(options, client, read, read_ms, False, self.sight(options))
        self.queue.submit(frame, partial(resolve, future))
        del read, frame
        try:
            result = await future
        finally:
            del future  # avoids a cycle, as in `predict_file`
        self.record_answer(options, client, result)
        return result

    def record_answer(self, options: RequestOptions, client: str, result: FrameResult) -> None:
        """Count an answer, and log it if `log_answers` is set."""
        total_s = (time.monotonic_ns() - options.stamp_ns) / 1e9
        self._metrics.count_answer(result, total_s, self.queue.waiting)
        if self._log_answers:
            log_answer(options.request_id, client, 1e3 * total_s)

    def record_refusal(self, error: Problem | ImageError, request_id: str, client: str) -> Problem:
        """Count and log an error; returns the problem for the reply."""
        forget_frames(error)
        problem = as_problem(error)
        self._count_refusal(problem, request_id, client)
        return problem

    def _count_refusal(self, problem: Problem, request_id: str, client: str) -> None:
        self.refusals.log(request_id, client, problem)
        self._metrics.count_refusal(problem.type, self.queue.waiting)


def forget_frames(error: BaseException) -> None:
    """Drop the tracebacks of an error and of its causes: their frames can reference the body of the
    request, and the error itself, which makes a cycle."""
    found: BaseException | None = error
    while found is not None:
        found.__traceback__ = None
        found = found.__cause__ or found.__context__


class FeaturesRequest:
    """One request, from its headers to its reply: call `open`, then `submit` with its body.

    `send` is called once with the reply. If the client disconnects before its body is complete,
    call `abandon`; then `send` is not called.
    """

    __slots__ = ("_client", "_crop", "_frames", "_options", "_request_id", "_send", "_share")

    def __init__(self, frames: FrameHandler, client: str, send: Callable[[Reply], None]) -> None:
        self._frames = frames
        self._client = client
        self._send = send
        self._share = frames.share()

    def grow(self, size: int) -> None:
        """Reserve memory for `size` more bytes of the body. Raises Problem."""
        check_body_size(self._share.size + size)
        self._share.grow(size)

    def abandon(self) -> None:
        """Release the request's memory because the client has disconnected."""
        self._share.close()

    def open(self, headers: Headers) -> bool:
        """Check the headers; returns False after a refusal, when the body is not needed."""
        stamp_ns = time.monotonic_ns()
        self._request_id = request_id_of(headers)
        try:
            if b"x-stream-id" not in headers:
                # An overloaded worker must not read bodies.
                self._frames.queue.check_capacity(self._client)
            self._options = parse_options(headers, stamp_ns, self._request_id)
            check_image_headers(headers)
        except Problem as problem:
            self.refuse(problem)
            return False
        return True

    def submit(self, body: bytes) -> None:
        """Queue the complete body."""
        try:
            self._crop = self._frames.submit(self._options, body, self._client, self._on_result)
        except (Problem, ImageError) as error:
            self.refuse(error)
        except Exception:
            logger.exception("request %s failed", self._request_id)
            self.refuse(internal_error())

    def refuse(self, error: Problem | ImageError) -> None:
        """Reply with the problem of an error."""
        self._share.close()
        problem = self._frames.record_refusal(error, self._request_id, self._client)
        self._send(problem_reply(problem, (b"x-request-id", self._request_id.encode())))

    def _on_result(self, result: FrameResult | Exception) -> None:
        if isinstance(result, Problem | ImageError):
            self.refuse(result)
            return
        try:
            if isinstance(result, Exception):
                raise result
            reply = self._reply(result)
        except Exception:
            logger.exception("request %s failed", self._request_id)
            self.refuse(internal_error())
        else:
            self._share.close()
            self._send(reply)

    def _reply(self, result: FrameResult) -> Reply:
        options = self._options
        self._frames.record_answer(options, self._client, result)
        headers = [(b"x-request-id", self._request_id.encode()), options.format.header]
        content = response_content(options, result, self._crop)
        return Reply(200, headers, options.format.encode(content))


RequestFactory = Callable[[FrameHandler, str, Callable[[Reply], None]], FeaturesRequest]
"""Makes a request from its handler, the client's address and the function that sends the reply."""


class FeaturesEndpoint:
    """POST /features as an ASGI application."""

    def __init__(
        self, frames: FrameHandler, make_request: RequestFactory = FeaturesRequest
    ) -> None:
        self._frames = frames
        self._make_request = make_request

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        reply: asyncio.Future[Reply] = asyncio.get_running_loop().create_future()
        client = client_address(scope)
        try:
            headers = read_options(scope)
        except Problem as problem:
            request_id = request_id_of(dict(scope["headers"]))
            problem = self._frames.record_refusal(problem, request_id, client)
            sent = (b"x-request-id", request_id.encode())
            await send_reply(send, problem_reply(problem, sent))
            return
        request = self._make_request(self._frames, client, partial(resolve, reply))
        if request.open(headers):
            try:
                request.submit(await read_body(receive, request.grow))
            except ClientDisconnectedError:
                request.abandon()
                return
            except Problem as problem:
                request.refuse(problem)
        await send_reply(send, await reply)


def resolve(future: "asyncio.Future[Any]", result: Any) -> None:
    """Set a future's result or exception; no effect if the future was cancelled."""
    if future.done():
        return
    if isinstance(result, Exception):
        future.set_exception(result)
    else:
        future.set_result(result)


def _frame(
    options: RequestOptions,
    client: str,
    read: PixelReader,
    read_ms: float,
    small: bool,
    sight: Sight,
) -> Frame:
    stream = stream_key(client, options.stream) if options.stream else 0
    return Frame(
        read, options.stamp_ns, stream, options.deadline_ns, small, client, read_ms, sight.camera
    )


def client_address(scope: Scope) -> str:
    """The client's address; empty if it is unknown."""
    client = scope.get("client")
    return client[0] if client else ""


def response_content(
    options: RequestOptions, result: FrameResult, crop: list[int] | None
) -> dict[str, Any]:
    """The answer. For speed it is not validated against the schema here; the tests do that."""
    return {
        **result.prediction.as_json(),
        **result.provenance,
        "crop_px": crop,
        "timing_ms": {
            "queue": round(result.queue_ms, 3),
            "decode": round(result.decode_ms, 3),
            "forward": round(result.forward_ms, 3),
            "total": round((time.monotonic_ns() - options.stamp_ns) / 1e6, 3),
        },
        "frame_id": options.frame_id,
    }
