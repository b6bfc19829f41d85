"""Web pages of the service: the console at `/` and the API documentation (Swagger UI) at `/docs`.

The files of Swagger UI come from the package fastapi-offline. The pages load nothing from other
sites, and the content security policy forbids inline scripts.
"""

import json
import mimetypes
from collections.abc import Callable
from importlib.resources import files
from pathlib import Path

from fastapi import FastAPI
from fastapi.responses import Response

DOCS_PATH = "/docs"
FOLDER = Path(__file__).parents[1] / "console"
PAGES = {"index.html", "docs.html"}
SWAGGER_UI_FILES = ("swagger-ui-bundle.js", "swagger-ui.css")
HEADERS = {
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self'; "
    "connect-src 'self'; img-src 'self' blob: data:; media-src blob:; base-uri 'none'; "
    "form-action 'none'; frame-ancestors 'none'",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cache-Control": "no-cache",  # browsers revalidate, for updates of the service
}


def add_console(app: FastAPI) -> None:
    """Add the pages and each file that they load to `app`."""
    app.get("/", include_in_schema=False)(_file_route(FOLDER / "index.html"))
    for path in sorted(FOLDER.iterdir()):
        if path.name not in PAGES:
            app.get(f"/console/{path.name}", include_in_schema=False)(_file_route(path))
    swagger_ui = Path(str(files("fastapi_offline"))) / "static"
    for name in SWAGGER_UI_FILES:
        app.get(f"/console/{name}", include_in_schema=False)(_file_route(swagger_ui / name))

    @app.get(DOCS_PATH, include_in_schema=False)
    def docs() -> Response:
        return Response(docs_page(app), media_type="text/html", headers=HEADERS)


def docs_page(app: FastAPI) -> str:
    """Return the HTML of `/docs`. It contains the OpenAPI document, because /openapi.json can
    require a token."""
    document = json.dumps(app.openapi()).replace("<", "\\u003c")
    return (FOLDER / "docs.html").read_text(encoding="utf-8").replace("{{openapi}}", document)


def _file_route(path: Path) -> Callable[[], Response]:
    media_type, _ = mimetypes.guess_type(path.name)

    def send() -> Response:
        return Response(path.read_bytes(), media_type=media_type, headers=HEADERS)

    return send
