"""GET /stream: a WebSocket that receives frames and sends answers, by the rules of POST /features.

A binary message is one image. Its answer is a text message with JSON, or with the subprotocol
`driverview.msgpack` a binary message with MessagePack. A new frame replaces a queued frame of the
same WebSocket. A text message before an image is a JSON object with options of this image:
`frame_id`, `deadline_ms`, `fov_y`, `camera`; a second one before the same image is refused. Options
for all images are sent with the handshake, as headers (e.g. X-Camera-Fov-Y) or, from a browser, in
the query. A refused frame is answered with its problem and its frame_id; the WebSocket stays open.
"""

import asyncio
import contextlib
import logging
import time
from dataclasses import dataclass, replace
from http import HTTPStatus

from mtlnet.inference.image_decoding.errors import ImageError
from serve.api.features import FrameHandler
from serve.api.request_options import (
    CAMERA,
    FRAME_ID,
    JSON,
    KEYS,
    MSGPACK,
    OPTIONS,
    Headers,
    RequestOptions,
    check_names,
    merge_options,
    parse_deadline,
    parse_fov_deg,
    parse_json_object,
    parse_name,
    parse_options,
    read_options,
    request_id_of,
)
from serve.asgi import Message, Receive, Scope, Send, client_address, send_reply
from serve.problems import INVALID_REQUEST, NOT_FOUND, Problem, internal_error
from serve.replies import problem_reply
from serve.scheduling.rate_limit import RateLimiter

PATH = "/stream"
PROTOCOLS = {"driverview.json": JSON, "driverview.msgpack": MSGPACK}
# Pauses (s) after a refused message, so that a client with many refused messages does not delay
# other clients. The second pause follows a refusal with status 503.
REFUSAL_PAUSE_S, BUSY_PAUSE_S = 0.01, 0.002
MAX_TEXT = 1024  # largest number of characters of a text message
FRAME_OPTIONS = {name: OPTIONS[name] for name in ("frame_id", "deadline_ms", "fov_y", "camera")}
MAX_PENDING = 8  # unanswered frames of one WebSocket; at this number no more are received

logger = logging.getLogger(__name__)


@dataclass(slots=True)
class StreamOptions:
    """The options in the handshake of a WebSocket, which are the `defaults` of its frames.

    `protocol`: the accepted subprotocol, if there is one; `deadline_ms`: the text that was sent;
    `client`: address of the client.
    """

    defaults: RequestOptions
    protocol: str | None
    deadline_ms: bytes | None
    client: str
    pause_s: float = 0.0
    """Time in s to wait before the next message is received; above 0 after a refusal."""


class Stream:
    """GET /stream as an ASGI application for WebSockets."""

    def __init__(self, frames: FrameHandler, rate_limiter: RateLimiter) -> None:
        self._frames = frames
        self._rate_limiter = rate_limiter

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        await receive()  # websocket.connect
        request_id = request_id_of(dict(scope["headers"]))
        headers = [(b"x-request-id", request_id.encode())]
        try:
            options = _parse_handshake(scope, request_id)
        except Problem as error:
            problem = self._frames.record_refusal(error, request_id, client_address(scope))
            await send_reply(send, problem_reply(problem, *headers), "websocket.http")
            return
        accept = {"type": "websocket.accept", "subprotocol": options.protocol, "headers": headers}
        await send(accept)
        await self._receive_frames(options, receive, send)

    async def _receive_frames(self, options: StreamOptions, receive: Receive, send: Send) -> None:
        pending: set[asyncio.Task[None]] = set()
        number = 0
        texts: tuple[str, ...] = ()
        while (message := await receive())["type"] == "websocket.receive":
            if message.get("bytes") is None:
                # Cut, so that an idle client keeps no megabytes in memory.
                texts = (*texts[:1], message["text"][: MAX_TEXT + 1])
                message.clear()
                continue
            number += 1
            stamp_ns = time.monotonic_ns()
            answer = self._answer(options, stamp_ns, str(number), texts, message, send)
            task = asyncio.ensure_future(answer)
            texts = ()
            pending.add(task)
            task.add_done_callback(pending.discard)
            await asyncio.sleep(0)  # queue this frame before the next one is received
            if options.pause_s:
                await asyncio.sleep(options.pause_s)
                options.pause_s = 0.0
            if len(pending) >= MAX_PENDING:
                await asyncio.wait(pending, return_when=asyncio.FIRST_COMPLETED)
        for task in pending:
            task.cancel()

    async def _answer(
        self,
        stream: StreamOptions,
        stamp_ns: int,
        number: str,
        texts: tuple[str, ...],
        message: Message,
        send: Send,
    ) -> None:
        """Answer the image in `message`, and empty `message` before the answer is sent: a slow
        client must not keep its image in memory.

        `stamp_ns`: time of arrival, ns of the monotonic clock. `number`: number of the image in its
        WebSocket, from 1. `texts`: the first two text messages before the image.
        """
        request_id = f"{stream.defaults.request_id}/{number}"
        frame_id = stream.defaults.frame_id or number
        share = self._frames.share()
        try:
            share.grow(len(message["bytes"]))
            self._rate_limiter.check(stream.client)
            headers = _parse_texts(texts)
            frame_id = parse_name(headers.get(KEYS["frame_id"]), FRAME_ID) or frame_id
            deadline_ms = headers.get(KEYS["deadline_ms"], stream.deadline_ms)
            fov_deg = parse_fov_deg(headers.get(KEYS["fov_y"]))
            camera = parse_name(headers.get(KEYS["camera"]), CAMERA)
            if fov_deg is None and camera is None:
                fov_deg, camera = stream.defaults.fov_y_deg, stream.defaults.camera
            options = replace(
                stream.defaults,
                stamp_ns=stamp_ns,
                request_id=request_id,
                frame_id=frame_id,
                deadline_ns=parse_deadline(deadline_ms, stamp_ns),
                fov_y_deg=fov_deg,
                camera=camera,
            )
            content = await self._frames.predict_file(options, message["bytes"], stream.client)
        except (Problem, ImageError) as error:
            problem = self._frames.record_refusal(error, request_id, stream.client)
            content = problem.content
            is_busy = problem.type.status == HTTPStatus.SERVICE_UNAVAILABLE
            stream.pause_s = BUSY_PAUSE_S if is_busy else REFUSAL_PAUSE_S
        except Exception:
            logger.exception("request %s failed", request_id)
            problem = internal_error()
            content = self._frames.record_refusal(problem, request_id, stream.client).content
        finally:
            message.clear()
            share.close()
        content["frame_id"] = frame_id
        data = stream.defaults.format.encode(content)
        is_json = stream.defaults.format is JSON
        sent = {"text": data.decode()} if is_json else {"bytes": data}
        with contextlib.suppress(OSError):  # the client has left
            await send({"type": "websocket.send", **sent})


def _parse_handshake(scope: Scope, request_id: str) -> StreamOptions:
    """Parse the options of a WebSocket in its handshake. Raises Problem."""
    if scope["path"] != PATH:
        raise Problem(NOT_FOUND, f"there is no WebSocket at {scope['path']}; use {PATH}")
    headers = read_options(scope)
    options = parse_options(headers, time.monotonic_ns(), request_id)
    protocol = next((p for p in scope["subprotocols"] if p in PROTOCOLS), None)
    response_format = PROTOCOLS[protocol] if protocol else options.format
    # Each WebSocket is a separate stream, unless its handshake names a stream.
    stream = options.stream or f"websocket {request_id_of({})}"
    options = replace(options, stream=stream, format=response_format)
    return StreamOptions(options, protocol, headers.get(KEYS["deadline_ms"]), client_address(scope))


def _parse_texts(texts: tuple[str, ...]) -> Headers:
    """Parse the options in the text messages before an image; return them as headers. Raises
    Problem, also for a second text message, because options of the first one could be lost."""
    if not texts:
        return {}
    if len(texts) > 1:
        seen = "more than one text message precedes the image; send all its options in one message"
        raise Problem(INVALID_REQUEST, seen)
    (text,) = texts
    metadata = parse_json_object(text, "a text message") if len(text) <= MAX_TEXT else None
    if metadata is None:
        raise Problem(
            INVALID_REQUEST,
            f"a text message must be a JSON object with some of {', '.join(FRAME_OPTIONS)}, of at "
            f"most {MAX_TEXT} characters",
        )
    check_names(metadata, FRAME_OPTIONS, "a text message")
    return merge_options({}, metadata, "a text message")
