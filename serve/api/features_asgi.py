"""POST /features as an ASGI application, for the requests that `serve.server.fast_path` does not
handle, and for ASGI servers other than `serve.server`."""

import asyncio
from functools import partial

from serve.api.features import FeaturesRequest, FrameHandler, resolve
from serve.api.request_options import read_options, request_id_of
from serve.asgi import (
    ClientDisconnectedError,
    Receive,
    Scope,
    Send,
    client_address,
    read_body,
    send_reply,
)
from serve.problems import Problem
from serve.replies import Reply, problem_reply


class FeaturesEndpoint:
    """POST /features as an ASGI application."""

    def __init__(self, frames: FrameHandler) -> None:
        self._frames = frames

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
        request = FeaturesRequest(self._frames, client, partial(resolve, reply))
        if request.open(headers):
            try:
                request.submit(await read_body(receive, request.receive))
            except ClientDisconnectedError:
                request.abandon()
                return
            except Problem as problem:
                request.refuse(problem)
        await send_reply(send, await reply)
