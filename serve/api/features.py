"""POST /features, whatever carries it. What it takes and gives is in `serve.api.schemas`.

The service's own connections (`serve.server.fast_path`) open an `FeaturesRequest` for each request;
`FeaturesEndpoint` is the same as an ASGI application, for other servers.
"""

import asyncio
import logging
import time
from collections.abc import Callable
from functools import partial
from typing import Any

from mtlnet.inference.image_decoding.crop import crop_box
from mtlnet.inference.image_decoding.decode import decode, inspect
from mtlnet.inference.image_decoding.errors import ImageError
from serve.api.http_io import (
    Departed,
    Receive,
    Reply,
    Scope,
    Send,
    as_problem,
    read_body,
    refusal,
    reply,
)
from serve.api.problems import Problem, failure
from serve.api.request_options import Headers, RequestOptions, check_headers, read_ask, request_id
from serve.observability.logs import Refusals, tell_answer
from serve.observability.metrics import Metrics
from serve.scheduling.frame_queue import Done, Frame, FrameQueue, Perceived, Reader
from serve.scheduling.streams import stream_key
from trackfeatures.camera import CameraParameters

SMALL_PIXELS = 640 * 480  # decoded in a millisecond or two

logger = logging.getLogger(__name__)


class FrameHandler:
    """What every way into the service does with a frame: see it, count it, tell of it."""

    def __init__(self, perceiver: FrameQueue, metrics: Metrics, log_answers: bool) -> None:
        self.perceiver = perceiver
        self._metrics = metrics
        self._refusals = Refusals()
        self._log_answers = log_answers

    def admit(self, ask: RequestOptions, body: bytes, client: str, done: Done) -> list[int] | None:
        """Have `done` called with what the model sees in an image's bytes, or with an error.

        The part of the image that it sees, as in `crop_of`. Raises Problem, ImageError.
        """
        self.perceiver.check_ready()
        if ask.stream is None:
            self.perceiver.check_room()  # who has too much to do reads no headers of images
        camera, fov = self.perceiver.loaded.engine.card.camera, ask.fov_y_deg
        header = inspect(body, camera, fov)
        small = header.width * header.height <= SMALL_PIXELS
        frame = _frame(ask, client, lambda view: decode(body, header, view, fov), small)
        self.perceiver.admit(frame, done)
        return crop_of(header.width, header.height, camera, fov)

    async def look(self, ask: RequestOptions, body: bytes, client: str) -> dict[str, Any]:
        """What `serve.api.schemas.FeaturesEndpoint` says of an image's bytes. Raises Problem,
        ImageError."""
        future: asyncio.Future[Perceived] = asyncio.get_running_loop().create_future()
        crop = self.admit(ask, body, client, partial(settle, future))
        perceived = await future
        self.answered(ask, client, perceived)
        return content_of(ask, perceived, crop)

    async def see(self, ask: RequestOptions, client: str, read: Reader) -> Perceived:
        """What the model sees in the pixels that `read` gives. Raises Problem, ImageError."""
        future: asyncio.Future[Perceived] = asyncio.get_running_loop().create_future()
        self.perceiver.admit(_frame(ask, client, read, False), partial(settle, future))
        perceived = await future
        self.answered(ask, client, perceived)
        return perceived

    def answered(self, ask: RequestOptions, client: str, perceived: Perceived) -> None:
        """Count an answer; told to the log where that is wanted."""
        total_s = (time.monotonic_ns() - ask.stamp_ns) / 1e9
        self._metrics.answered(perceived, total_s, self.perceiver.waiting)
        if self._log_answers:
            tell_answer(ask.request_id, client, 1e3 * total_s)

    def refused(self, error: Problem | ImageError, request: str, client: str) -> Problem:
        """The problem that an error is to a client; counted, and told to the log."""
        problem = as_problem(error)
        self._refusals.tell(request, client, problem)
        self._metrics.refused(problem.kind, self.perceiver.waiting)
        return problem


class FeaturesRequest:
    """One request, from its headers to its reply: `open`, then `take` its body.

    `send` is called once, unless the client departs before its body is whole.
    """

    __slots__ = ("_ask", "_client", "_crop", "_name", "_send", "_sight")

    def __init__(self, sight: FrameHandler, client: str, send: Callable[[Reply], None]) -> None:
        self._sight = sight
        self._client = client
        self._send = send

    def open(self, headers: Headers) -> bool:
        """Whether the body is wanted; if not, it was refused."""
        stamp = time.monotonic_ns()
        self._name = request_id(headers)
        try:
            if b"x-stream-id" not in headers:
                self._sight.perceiver.check_room()  # who has too much to do reads no more
            self._ask = read_ask(headers, stamp, self._name)
            check_headers(headers)
        except Problem as problem:
            self.refuse(problem)
            return False
        return True

    def take(self, body: bytes) -> None:
        """Have the whole body answered."""
        try:
            self._crop = self._sight.admit(self._ask, body, self._client, self._answer)
        except (Problem, ImageError) as error:
            self.refuse(error)
        except Exception:
            logger.exception("request %s failed", self._name)
            self.refuse(failure())

    def refuse(self, error: Problem | ImageError) -> None:
        """Reply with the problem that an error is."""
        problem = self._sight.refused(error, self._name, self._client)
        self._send(refusal(problem, (b"x-request-id", self._name.encode())))

    def _answer(self, result: Perceived | Exception) -> None:
        try:
            if isinstance(result, Exception):
                raise result
            reply = self._reply(result)
        except (Problem, ImageError) as error:
            self.refuse(error)
        except Exception:
            logger.exception("request %s failed", self._name)
            self.refuse(failure())
        else:
            self._send(reply)

    def _reply(self, perceived: Perceived) -> Reply:
        ask = self._ask
        self._sight.answered(ask, self._client, perceived)
        headers = [(b"x-request-id", self._name.encode()), ask.format.header]
        return Reply(200, headers, ask.format.encode(content_of(ask, perceived, self._crop)))


class FeaturesEndpoint:
    """The endpoint, as an ASGI application."""

    def __init__(
        self,
        sight: FrameHandler,
        begin: Callable[
            [FrameHandler, str, Callable[[Reply], None]], FeaturesRequest
        ] = FeaturesRequest,
    ) -> None:
        self._sight = sight
        self._begin = begin

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        found: asyncio.Future[Reply] = asyncio.get_running_loop().create_future()
        exchange = self._begin(self._sight, client_of(scope), partial(settle, found))
        if exchange.open(dict(scope["headers"])):
            try:
                exchange.take(await read_body(receive))
            except Departed:
                return
            except Problem as problem:
                exchange.refuse(problem)
        await reply(send, await found)


def settle(future: "asyncio.Future[Any]", result: Any) -> None:
    """Give a future its result, or the exception that it is; none is due to who was cancelled."""
    if future.done():
        return
    if isinstance(result, Exception):
        future.set_exception(result)
    else:
        future.set_result(result)


def _frame(ask: RequestOptions, client: str, read: Reader, small: bool) -> Frame:
    stream = stream_key(client, ask.stream) if ask.stream else 0
    return Frame(read, ask.stamp_ns, stream, ask.deadline_ns, small)


def client_of(scope: Scope) -> str:
    """The address of whoever asks."""
    client = scope.get("client")
    return client[0] if client else ""


def crop_of(
    width: int, height: int, view: CameraParameters, fov_y_deg: float | None
) -> list[int] | None:
    """[left, top, width, height] of what the model sees of a picture, px; None: all of it."""
    box = crop_box(width, height, view, fov_y_deg)
    return None if box is None else [box.left, box.top, box.width, box.height]


def content_of(ask: RequestOptions, perceived: Perceived, crop: list[int] | None) -> dict[str, Any]:
    """The answer, not through the schema: the tests hold it to that, once for all requests."""
    return {
        **perceived.answer.as_json(),
        **perceived.origin,
        "crop_px": crop,
        "timing_ms": {
            "queue": round(perceived.queue_ms, 3),
            "decode": round(perceived.decode_ms, 3),
            "forward": round(perceived.forward_ms, 3),
            "total": round((time.monotonic_ns() - ask.stamp_ns) / 1e6, 3),
        },
        "frame_id": ask.frame_id,
    }
