"""GET /stream: frames and answers over one WebSocket, with the rules of POST /features.

A binary message is one image; its answer is a text message of JSON, or with the subprotocol
`driverview.msgpack` a binary one of MessagePack. A frame that comes while another of the same
WebSocket waits takes its place. A text message before an image is a JSON object for that image:
`frame_id`, `deadline_ms`. What holds for all images goes with the handshake: X-Camera-Fov-Y,
X-Deadline-Ms, X-Stream-Id, or, from a browser, ?fov_y=&deadline_ms=. A frame that is refused is
answered by its problem and its frame_id; the WebSocket stays open.
"""

import asyncio
import logging
import time
from dataclasses import dataclass, replace
from typing import Any
from urllib.parse import parse_qs, urlsplit

import msgspec

from mtlnet.inference.image_decoding.errors import ImageError
from serve.api.features import FrameHandler, client_of
from serve.api.http_io import Receive, Scope, Send, refusal, reply
from serve.api.problems import FORBIDDEN_ORIGIN, INVALID_REQUEST, NOT_FOUND, Problem, failure
from serve.api.request_options import (
    JSON,
    MSGPACK,
    Headers,
    RequestOptions,
    is_name,
    read_ask,
    read_deadline,
    read_fov,
    request_id,
)
from serve.scheduling.rate_limit import Rate

PATH = "/stream"
PROTOCOLS = {"driverview.json": JSON, "driverview.msgpack": MSGPACK}
MAX_UNSENT = 8  # answers that wait for a client who does not read them; then no more is read

logger = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Terms:
    """What a handshake agreed on; `deadline_ms` as it was sent."""

    ask: RequestOptions
    protocol: str | None
    deadline_ms: str | None
    client: str


class Stream:
    """The endpoint, as an ASGI application for WebSockets."""

    def __init__(self, sight: FrameHandler, rate: Rate) -> None:
        self._sight = sight
        self._rate = rate

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        await receive()  # websocket.connect
        name = request_id(dict(scope["headers"]))
        try:
            terms = _agree(scope, name)
        except Problem as problem:
            found = self._sight.refused(problem, name, client_of(scope))
            await reply(send, refusal(found), "websocket.http")
            return
        headers = [(b"x-request-id", name.encode())]
        await send({"type": "websocket.accept", "subprotocol": terms.protocol, "headers": headers})
        await self._talk(terms, receive, send)

    async def _talk(self, terms: Terms, receive: Receive, send: Send) -> None:
        unsent: set[asyncio.Task[None]] = set()
        number, about = 0, ""
        while (message := await receive())["type"] == "websocket.receive":
            if message.get("bytes") is None:
                about = message["text"]
                continue
            number += 1
            stamp = time.monotonic_ns()
            task = asyncio.ensure_future(
                self._answer(terms, stamp, str(number), about, message["bytes"], send)
            )
            about = ""
            unsent.add(task)
            task.add_done_callback(unsent.discard)
            await asyncio.sleep(0)  # the frame goes into the queue before the next is read
            if len(unsent) >= MAX_UNSENT:
                await asyncio.wait(unsent, return_when=asyncio.FIRST_COMPLETED)
        for task in unsent:
            task.cancel()

    async def _answer(
        self, terms: Terms, stamp_ns: int, number: str, about: str, body: bytes, send: Send
    ) -> None:
        name, frame_id = f"{terms.ask.request_id}/{number}", number
        try:
            self._rate.check(terms.client)
            frame_id, deadline_ms = _read_about(about, number, terms.deadline_ms)
            ask = replace(
                terms.ask,
                stamp_ns=stamp_ns,
                request_id=name,
                frame_id=frame_id,
                deadline_ns=read_deadline(deadline_ms, stamp_ns),
            )
            content = await self._sight.look(ask, body, terms.client)
        except (Problem, ImageError) as error:
            content = self._sight.refused(error, name, terms.client).content
        except Exception:
            logger.exception("request %s failed", name)
            content = self._sight.refused(failure(), name, terms.client).content
        content["frame_id"] = frame_id
        data = terms.ask.format.encode(content)
        if terms.ask.format is JSON:
            await send({"type": "websocket.send", "text": data.decode()})
        else:
            await send({"type": "websocket.send", "bytes": data})


def _agree(scope: Scope, name: str) -> Terms:
    """What the handshake asks for. Raises Problem."""
    headers: Headers = dict(scope["headers"])
    if scope["path"] != PATH:
        raise Problem(NOT_FOUND, f"there is no WebSocket at {scope['path']}, but at {PATH}")
    _check_origin(headers)
    query = parse_qs(scope["query_string"].decode("latin-1"))
    ask = read_ask(headers, time.monotonic_ns(), name)
    if "fov_y" in query:
        ask = replace(ask, fov_y_deg=read_fov(query["fov_y"][0]))
    deadline = headers.get(b"x-deadline-ms", b"").decode("latin-1") or None
    deadline = query.get("deadline_ms", [deadline])[0]
    read_deadline(deadline, 0)
    protocol = next((p for p in scope["subprotocols"] if p in PROTOCOLS), None)
    form = PROTOCOLS[protocol] if protocol else ask.format
    # Each WebSocket is a stream of its own, unless it says that it goes on with another.
    ask = replace(ask, stream=ask.stream or f"websocket {name}", format=form)
    return Terms(ask, protocol, deadline, client_of(scope))


def _check_origin(headers: Headers) -> None:
    """A page of another site, open in a browser here, may not use this service unasked."""
    origin = headers.get(b"origin")
    if origin is None:
        return
    if urlsplit(origin.decode("latin-1")).netloc.encode("latin-1") != headers.get(b"host"):
        raise Problem(FORBIDDEN_ORIGIN, f"the page's origin is {origin[:80].decode('latin-1')!r}")


def _read_about(text: str, number: str, deadline_ms: str | None) -> tuple[str, str | None]:
    """(frame_id, deadline_ms) of a frame with this text message before it. Raises Problem."""
    if not text:
        return number, deadline_ms
    try:
        about: Any = msgspec.json.decode(text)
    except msgspec.DecodeError:
        about = None
    if not isinstance(about, dict) or not about.keys() <= {"frame_id", "deadline_ms"}:
        raise Problem(
            INVALID_REQUEST,
            "a text message must be a JSON object with frame_id and deadline_ms, or one of them",
        )
    frame_id = str(about.get("frame_id", number))
    if not is_name(frame_id.encode()):
        raise Problem(INVALID_REQUEST, "frame_id must be printable ASCII, 128 characters at most")
    return frame_id, str(about["deadline_ms"]) if "deadline_ms" in about else deadline_ms
