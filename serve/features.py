"""POST /features: the hot path, as plain ASGI. What it takes and gives is in `serve.contract`."""

import logging
import time
from typing import Any

from mtlnet.image_error import ImageError
from mtlnet.images import decode, inspect
from mtlnet.view import View, visible
from serve.ask import Ask, Headers, check_headers, read_ask, request_id
from serve.gate import Departed, Header, Receive, Scope, Send, as_problem, read_body, refuse, reply
from serve.logs import Refusals, tell_answer
from serve.metrics import Metrics
from serve.perceiver import Frame, Perceived, Perceiver, Reader
from serve.problems import Problem, failure
from serve.streams import stream_key

logger = logging.getLogger(__name__)


class Sight:
    """What every way into the service does with a frame: see it, count it, tell of it."""

    def __init__(self, perceiver: Perceiver, metrics: Metrics, log_answers: bool) -> None:
        self.perceiver = perceiver
        self._metrics = metrics
        self._refusals = Refusals()
        self._log_answers = log_answers

    async def look(self, ask: Ask, body: bytes, client: str) -> dict[str, Any]:
        """What `serve.contract.Features` says of an image's bytes. Raises Problem, ImageError."""
        self.perceiver.check_ready()
        camera = self.perceiver.loaded.engine.card.camera
        header = inspect(body, camera, ask.fov_y_deg)
        fov = ask.fov_y_deg
        perceived = await self.see(ask, client, lambda view: decode(body, header, view, fov))
        return content_of(ask, perceived, crop_of(header.width, header.height, camera, fov))

    async def see(self, ask: Ask, client: str, read: Reader) -> Perceived:
        """What the model sees in the pixels that `read` gives. Raises Problem, ImageError."""
        stream = stream_key(client, ask.stream) if ask.stream else 0
        frame = Frame(read, ask.stamp_ns, stream, ask.deadline_ns)
        perceived = await self.perceiver.perceive(frame)
        total_s = (time.monotonic_ns() - ask.stamp_ns) / 1e9
        self._metrics.answered(perceived, total_s, self.perceiver.waiting)
        if self._log_answers:
            tell_answer(ask.request_id, client, 1e3 * total_s)
        return perceived

    def refused(self, error: Problem | ImageError, request: str, client: str) -> Problem:
        """The problem that an error is to a client; counted, and told to the log."""
        problem = as_problem(error)
        self._refusals.tell(request, client, problem)
        self._metrics.refused(problem.kind, self.perceiver.waiting)
        return problem


class Features:
    """The endpoint, as an ASGI application."""

    def __init__(self, sight: Sight) -> None:
        self._sight = sight

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        stamp = time.monotonic_ns()
        headers: Headers = dict(scope["headers"])
        name = request_id(headers)
        sent: list[Header] = [(b"x-request-id", name.encode())]
        try:
            ask = read_ask(headers, stamp, name)
            check_headers(headers)
            body = await read_body(receive)
            content = await self._sight.look(ask, body, client_of(scope))
        except Departed:
            return
        except (Problem, ImageError) as error:
            await refuse(send, self._sight.refused(error, name, client_of(scope)), sent)
        except Exception:
            logger.exception("request %s failed", name)
            await refuse(send, self._sight.refused(failure(), name, client_of(scope)), sent)
        else:
            sent.append(ask.format.header)
            await reply(send, 200, sent, ask.format.encode(content))


def client_of(scope: Scope) -> str:
    """The address of whoever asks."""
    client = scope.get("client")
    return client[0] if client else ""


def crop_of(width: int, height: int, view: View, fov_y_deg: float | None) -> list[int] | None:
    """[left, top, width, height] of what the model sees of a picture, px; None: all of it."""
    box = visible(width, height, view, fov_y_deg)
    return None if box is None else [box.left, box.top, box.width, box.height]


def content_of(ask: Ask, perceived: Perceived, crop: list[int] | None) -> dict[str, Any]:
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
