"""The web server of a watched drive: one page, and one WebSocket per browser.

It runs in its own thread, so that the drive keeps the main thread.
"""

import asyncio
import contextlib
import socket
import threading
import time
from pathlib import Path
from typing import Final
from urllib.parse import urlsplit

import uvicorn
from fastapi import FastAPI, WebSocket, WebSocketDisconnect
from fastapi.responses import HTMLResponse, Response

from simulator.watch.hub import MAX_UNANSWERED, Browser, Hub
from simulator.watch.requests import BadRequest, parse
from trackfeatures.errors import UserError

PAGE: Final = Path(__file__).parent / "page.html"
FIRST_VIEW: Final = "chase"
START_S: Final = 10.0
STOP_S: Final = 2.0
POLICY_VIOLATION, TRY_LATER = 1008, 1013
# The page loads nothing from other hosts, and this policy forbids it.
POLICY: Final = (
    "default-src 'none'; style-src 'unsafe-inline'; script-src 'unsafe-inline'; "
    "img-src data: blob:; connect-src 'self' ws: wss:; base-uri 'none'; form-action 'none'"
)


def create_app(hub: Hub) -> FastAPI:
    """Create the web application for `hub`."""
    app = FastAPI(title="driverview: a live drive", openapi_url=None)

    @app.get("/")
    async def page() -> HTMLResponse:
        headers = {"Content-Security-Policy": POLICY, "Cache-Control": "no-store"}
        return HTMLResponse(PAGE.read_text(encoding="utf-8"), headers=headers)

    @app.get("/favicon.ico")
    async def icon() -> Response:
        return Response(status_code=204)

    @app.websocket("/live")
    async def live(connection: WebSocket) -> None:
        if not _own_page(connection):
            await connection.close(POLICY_VIOLATION)
            return
        await connection.accept()
        browser = hub.join(FIRST_VIEW)
        if browser is None:
            await connection.close(TRY_LATER, "too many browsers are watching")
            return
        sender = asyncio.create_task(_send(connection, hub, browser))
        try:
            await _receive(connection, hub, browser)
        finally:
            hub.leave(browser)
            sender.cancel()
            with contextlib.suppress(asyncio.CancelledError, WebSocketDisconnect, RuntimeError):
                await sender

    return app


async def _send(connection: WebSocket, hub: Hub, browser: Browser) -> None:
    """Send the latest state and image as soon as the browser has answered the previous ones."""
    while True:
        await browser.changed.wait()
        browser.changed.clear()
        latest = hub.latest
        if latest is None or browser.pending >= MAX_UNANSWERED:
            continue
        if latest.scene is not browser.scene:
            browser.scene = latest.scene
            await connection.send_text(latest.scene)
        taken, picture = latest.pictures.get(browser.view, (0, b""))
        fresh = picture != b"" and (browser.view, taken) != browser.picture
        if latest.number == browser.sent and not fresh:
            continue
        browser.sent = latest.number
        browser.pending += 1
        await connection.send_text(latest.state)
        if fresh:
            browser.picture = (browser.view, taken)
            await connection.send_bytes(picture)


async def _receive(connection: WebSocket, hub: Hub, browser: Browser) -> None:
    """Apply the browser's messages until the browser disconnects. Messages about the view and
    received pictures are handled here; all other messages are passed to the drive."""
    while True:
        try:
            request = parse(await connection.receive_text())
        except (WebSocketDisconnect, RuntimeError):
            return
        except (BadRequest, KeyError) as error:  # KeyError: bytes where text was expected
            await connection.close(POLICY_VIOLATION, str(error)[:120])
            return
        if request.kind == "got":
            browser.pending = 0 if request.value == browser.sent else max(browser.pending - 1, 0)
            browser.changed.set()
        elif request.kind == "view":
            browser.view = str(request.value)
            browser.changed.set()
        else:
            hub.submit(browser, request)


def _own_page(connection: WebSocket) -> bool:
    """Return whether the request comes from a page of this server, not of another site."""
    origin = connection.headers.get("origin")
    if origin is None:  # not a browser, since browsers always send an origin
        return True
    return urlsplit(origin).netloc == connection.headers.get("host")


class Server:
    """Serves the pages and messages of a `Hub` to browsers on a bound socket, in a thread, until
    `stop` is called."""

    def __init__(self, hub: Hub, listener: socket.socket) -> None:
        self._listener = listener
        self._server = uvicorn.Server(_settings(create_app(hub)))
        self._thread = threading.Thread(
            target=self._server.run, kwargs={"sockets": [listener]}, name="watch", daemon=True
        )

    def start(self) -> None:
        """Start the thread. Raises UserError if the server does not start within 10 s."""
        self._thread.start()
        deadline = time.monotonic() + START_S
        while not self._server.started:
            if not self._thread.is_alive() or time.monotonic() > deadline:
                raise UserError("the web server could not start; the lines above say why")
            time.sleep(0.005)

    def stop(self) -> None:
        """Close all connections and end the thread; browsers show that the drive has ended."""
        self._server.should_exit = self._server.force_exit = True  # does not wait for browsers
        self._thread.join(STOP_S)
        self._listener.close()


def _settings(app: FastAPI) -> uvicorn.Config:
    return uvicorn.Config(
        app,
        http="httptools",
        ws="websockets-sansio",
        lifespan="off",
        log_level="warning",
        access_log=False,
        server_header=False,
        ws_max_size=4096,
        ws_ping_interval=10.0,
        ws_ping_timeout=10.0,
        ws_per_message_deflate=False,  # pictures are compressed already
        timeout_graceful_shutdown=1,
    )
