"""The web console: one page at `/` that asks the service about images; it loads nothing from
elsewhere.

Its scripts use what any other client does: GET /model and POST /features.
"""

import mimetypes
from collections.abc import Callable
from pathlib import Path

from fastapi import FastAPI
from fastapi.responses import Response

FOLDER = Path(__file__).parents[1] / "console"
HEADERS = {
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self'; "
    "connect-src 'self'; img-src 'self' blob: data:; base-uri 'none'; form-action 'none'; "
    "frame-ancestors 'none'",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cache-Control": "no-cache",  # a browser asks again after an update of the service
}


def add_console(app: FastAPI) -> None:
    """Serve the page and each file it loads; nothing else of the folder's surroundings."""
    app.get("/", include_in_schema=False)(_sender(FOLDER / "index.html"))
    for path in sorted(FOLDER.iterdir()):
        if path.name != "index.html":
            app.get(f"/console/{path.name}", include_in_schema=False)(_sender(path))


def _sender(path: Path) -> Callable[[], Response]:
    kind, _ = mimetypes.guess_type(path.name)

    def send() -> Response:
        return Response(path.read_bytes(), media_type=kind, headers=HEADERS)

    return send
