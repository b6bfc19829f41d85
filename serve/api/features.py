"""Handles POST /features from the headers to the reply; `serve.api.schemas` defines the answer.

`serve.server.fast_path` creates a `FeaturesRequest` for each request, and `serve.api.features_asgi`
does so under ASGI. All endpoints for images use `FrameHandler`.
"""

import asyncio
import logging
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from mtlnet.inference.image_decoding.crop import crop_box
from mtlnet.inference.image_decoding.decode import (
    LATE_CHECK_BYTES,
    crop_and_resize,
    decode_whole,
    read_header,
)
from mtlnet.inference.image_decoding.errors import ImageError
from serve.api.request_options import (
    CAMERA,
    FIELD_OF_VIEW,
    Headers,
    RequestOptions,
    check_image_headers,
    parse_options,
    request_id_of,
)
from serve.observability.logs import RefusalLog, log_answer
from serve.observability.metrics import Metrics
from serve.problems import INVALID_REQUEST, Problem, as_problem, forget_frames, internal_error
from serve.replies import Reply, problem_reply
from serve.scheduling.body_budget import BodyBudget, BodyShare
from serve.scheduling.frame import Frame, FrameResult, PixelReader, ResultCallback
from serve.scheduling.frame_queue import FrameQueue
from serve.scheduling.loaded_engine import LoadedEngine
from serve.scheduling.streams import stream_key

if TYPE_CHECKING:
    from opentelemetry.trace import Span

    from serve.observability.tracing import RequestTracer

# Limits of pixels, estimated decoding time in ms and JPEG bytes for decoding on the event loop. The
# estimate depends on a JPEG's pixels only, so its bytes need a limit.
SMALL_PIXELS, SMALL_MS, SMALL_BYTES = 640 * 480, 12.0, LATE_CHECK_BYTES

logger = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class ImageCamera:
    """The camera of an image: the camera named `name` if it is given, otherwise the model's camera.
    In the second case `fov_y_deg`, if it is given, replaces the vertical field of view."""

    fov_y_deg: float | None = None
    name: str | None = None

    def crop_px(self, width: int, height: int, loaded: LoadedEngine) -> list[int] | None:
        """Return [left, top, width, height] in px of the part of an image that the model's camera
        shows; None if the part is the whole image, or if the image is warped.

        Raises ImageError if an image of this size does not cover what the model's camera shows.
        """
        if self.name is not None:
            loaded.rectification(self.name).check(width, height)
            return None
        box = crop_box(width, height, loaded.view, self.fov_y_deg)
        return None if box is None else [box.left, box.top, box.width, box.height]

    def to_model_view(self, image: NDArray[np.uint8], loaded: LoadedEngine) -> NDArray[np.uint8]:
        """Convert `image` (H, W, 3) of this camera to the view of the model's camera: uint8 RGB
        (view.height, view.width, 3). Raises ImageError."""
        if self.name is None:
            return crop_and_resize(image, loaded.view, self.fov_y_deg)
        return loaded.rectification(self.name).image(image)


class FrameHandler:
    """Handles the frames of all endpoints: queues them, counts and logs their results."""

    def __init__(
        self,
        queue: FrameQueue,
        metrics: Metrics,
        bodies: BodyBudget,
        refusals: RefusalLog,
        log_answers: bool,
        tracer: "RequestTracer | None" = None,
    ) -> None:
        self.queue = queue
        self.tracer = tracer
        self._bodies = bodies
        self._metrics = metrics
        self.refusals = refusals
        self._log_answers = log_answers

    def share(self) -> BodyShare:
        """Return a new request's share, initially 0 bytes, of the memory for request bodies."""
        return BodyShare(self._bodies)

    def submit(
        self, options: RequestOptions, body: bytes, client: str, on_result: ResultCallback
    ) -> list[int] | None:
        """Queue the image file in `body`; `on_result` is called with its result or an error.

        Returns [left, top, width, height] in px of the used part of the image, or None (see
        `ImageCamera.crop_px`). Raises Problem, ImageError.
        """
        self.queue.check_ready()
        source, header = self.image_camera(options), read_header(body)
        crop = source.crop_px(header.width, header.height, self.queue.loaded)
        small = header.width * header.height <= SMALL_PIXELS and header.decode_ms <= SMALL_MS
        small = small and (len(body) <= SMALL_BYTES or header.png_header is not None)

        def read(loaded: LoadedEngine) -> NDArray[np.uint8]:
            return source.to_model_view(decode_whole(body, header), loaded)

        frame = _frame(options, client, read, header.decode_ms, small, source)
        self.queue.submit(frame, on_result)
        return crop

    def image_camera(self, options: RequestOptions) -> ImageCamera:
        """Return the camera of a request's image. Raises Problem for an unknown camera."""
        name = options.camera
        if name is None:
            return ImageCamera(options.fov_y_deg)
        if options.fov_y_deg is not None:
            seen = f"{CAMERA} and {FIELD_OF_VIEW} are both given"
            raise Problem(INVALID_REQUEST, f"{seen}; the camera has a field of view, so send one")
        cameras = self.queue.loaded.cameras
        if name not in cameras:
            known = ", ".join(cameras) or "none (serve --camera NAME=FILE gives it one)"
            raise Problem(INVALID_REQUEST, f"{CAMERA} is {name[:80]!r}; the service knows {known}")
        return ImageCamera(None, name)

    async def predict_file(
        self, options: RequestOptions, body: bytes, client: str
    ) -> dict[str, Any]:
        """Return the answer to the image file in `body`, a dict with the members of
        `schemas.Features`. Raises Problem, ImageError."""
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
        """Return the result for the pixels that `read` returns; `read_ms` is the estimated time
        (ms) that `read` takes. Raises Problem, ImageError."""
        future: asyncio.Future[FrameResult] = asyncio.get_running_loop().create_future()
        frame = _frame(options, client, read, read_ms, False, self.image_camera(options))
        self.queue.submit(frame, partial(resolve, future))
        del read, frame
        try:
            result = await future
        finally:
            del future  # avoids a cycle, as in `predict_file`
        self.record_answer(options, client, result)
        return result

    def record_answer(
        self,
        options: RequestOptions,
        client: str,
        result: FrameResult,
        span: "Span | None" = None,
    ) -> None:
        """Count an answer, and log it if `log_answers` is set. `span` is the request's span in a
        trace."""
        total_s = (time.monotonic_ns() - options.stamp_ns) / 1e9
        self._metrics.count_answer(result, total_s, self.queue.waiting)
        if self._log_answers:
            log_answer(options.request_id, client, 1e3 * total_s)
        if self.tracer is not None:
            about = (options.stamp_ns, options.request_id, options.frame_id, client)
            self.tracer.record_answer(span, *about, result)

    def record_refusal(self, error: Problem | ImageError, request_id: str, client: str) -> Problem:
        """Count and log the error of a request; return the problem for the reply."""
        forget_frames(error)
        problem = as_problem(error)
        self.record_problem(problem, request_id, client)
        return problem

    def record_problem(
        self, problem: Problem, request_id: str, client: str, span: "Span | None" = None
    ) -> None:
        """Count and log the problem of a request. `span` is the request's span in a trace."""
        self.count_refusal(problem, request_id, client)
        if self.tracer is not None:
            self.tracer.record_problem(span, problem, request_id)

    def count_refusal(self, problem: Problem, request_id: str, client: str) -> None:
        """Count a refused request, and log it."""
        self.refusals.log(request_id, client, problem)
        self._metrics.count_refusal(problem.type, self.queue.waiting)


class FeaturesRequest:
    """One request, from its headers to its reply: call `open`, then `submit` with the body.

    `send` is called once with the reply. If the client disconnects before the body is complete,
    call `abandon`; then `send` is not called.
    """

    __slots__ = (
        *("_client", "_crop", "_frames", "_options", "_request_id", "_send", "_share", "_span"),
    )

    def __init__(self, frames: FrameHandler, client: str, send: Callable[[Reply], None]) -> None:
        self._frames = frames
        self._client = client
        self._send = send
        self._span: Span | None = None

    def receive(self, size: int) -> None:
        """Reserve memory for `size` more bytes of the body. Raises Problem."""
        self._share.receive(size)

    def abandon(self) -> None:
        """Release the request's memory because the client has disconnected."""
        self._share.close()

    def open(self, headers: Headers) -> bool:
        """Check the headers; return True if the body is needed, False if the request was
        refused."""
        stamp_ns = time.monotonic_ns()
        self._request_id = request_id_of(headers)
        frames = self._frames
        if frames.tracer is not None:
            self._span = frames.tracer.begin("/features", headers.items(), self._client)
        # An overloaded worker reads no bodies, except for frames that can replace a queued frame.
        full = None if b"x-stream-id" in headers else frames.queue.refusal(self._client)
        if full is not None:
            self._send_problem(full)
            return False
        self._share = frames.share()
        try:
            self._options = parse_options(headers, stamp_ns, self._request_id)
            check_image_headers(headers)
        except Problem as problem:
            self.refuse(problem)
            return False
        return True

    def submit(self, body: bytes) -> None:
        """Queue the image in the complete `body`; an error is sent as the reply."""
        try:
            self._crop = self._frames.submit(self._options, body, self._client, self._on_result)
        except (Problem, ImageError) as error:
            self.refuse(error)
        except Exception:
            logger.exception("request %s failed", self._request_id)
            self.refuse(internal_error())

    def refuse(self, error: Problem | ImageError) -> None:
        """Reply with the problem of `error`."""
        self._share.close()
        forget_frames(error)
        self._send_problem(as_problem(error))

    def _send_problem(self, problem: Problem) -> None:
        self._frames.record_problem(problem, self._request_id, self._client, self._span)
        self._finish(problem_reply(problem, (b"x-request-id", self._request_id.encode())))

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
            self._finish(reply)

    def _finish(self, reply: Reply) -> None:
        if self._span is not None and self._frames.tracer is not None:
            self._frames.tracer.end(self._span, reply.status)
        self._send(reply)

    def _reply(self, result: FrameResult) -> Reply:
        options = self._options
        self._frames.record_answer(options, self._client, result, self._span)
        headers = [(b"x-request-id", self._request_id.encode()), options.format.header]
        content = response_content(options, result, self._crop)
        return Reply(200, headers, options.format.encode(content))


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
    source: ImageCamera,
) -> Frame:
    stream = stream_key(client, options.stream) if options.stream else 0
    return Frame(
        read, options.stamp_ns, stream, options.deadline_ns, small, client, read_ms, source.name
    )


def response_content(
    options: RequestOptions, result: FrameResult, crop: list[int] | None
) -> dict[str, Any]:
    """Return the members of the answer. For speed, only tests validate them against the schema."""
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
