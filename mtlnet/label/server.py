"""The page of `mtlnet label FOLDER` and its JSON interface, on one local port.

Pictures are addressed by number, so that a request names no file. The headers Host and Origin of
every request, and its token if one is required, are checked by the rules of the HTTP service
(`runtime.access`). The page itself contains no data and needs no token.
"""

import signal
import sys
from collections.abc import Awaitable, Callable, MutableMapping
from dataclasses import asdict, replace
from hmac import compare_digest
from pathlib import Path
from threading import Lock
from typing import Annotated, Any, Literal

import cv2
import numpy as np
import simplejpeg
import uvicorn
from fastapi import FastAPI
from fastapi import Path as PathNumber
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse, Response
from pydantic import BaseModel, ConfigDict, Field

from mtlnet.data.labels_file import Cells, lane_sides
from mtlnet.inference.engine import Engine
from mtlnet.inference.image_decoding.errors import ImageError
from mtlnet.inference.prediction import decode_outputs
from mtlnet.inference.rectification import Rectification
from mtlnet.label.folder import LabelChangedError, LabelFolder, heading_of, row_version
from mtlnet.label.geometry import Markings, fit_markings, handles, marking_pixels
from runtime.access import HostNames
from runtime.cli import describe
from runtime.files import locked_folder, name_as_text
from runtime.sockets import address, bind_all
from trackfeatures.camera import CameraParameters
from trackfeatures.errors import UserError

PAGE = Path(__file__).parent / "page"
MEDIA_TYPES = {".html": "text/html", ".js": "text/javascript", ".css": "text/css"}
HEADERS = {
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self'; "
    "connect-src 'self'; img-src 'self' blob:; base-uri 'none'; form-action 'none'; "
    "frame-ancestors 'none'",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cache-Control": "no-store",
}
MAX_BODY_BYTES = 64 << 10
MAX_SHOWN_PX = 1600
"""Maximum of the longer side of a picture sent to the page, px."""
USUAL_LANE = -1.8, 1.8, 0.0, 0.0
"""Initial ml, mr (m), angle and curvature without an answer of the model: the car is in the middle
of a lane of 3.6 m."""

Scope = MutableMapping[str, Any]
Receive = Callable[[], Awaitable[MutableMapping[str, Any]]]
Send = Callable[[MutableMapping[str, Any]], Awaitable[None]]
Asgi = Callable[[Scope, Receive, Send], Awaitable[None]]
Number = Annotated[float, Field(allow_inf_nan=False)]
Pixel = Annotated[list[Number], Field(min_length=2, max_length=2)]
Pixels = Annotated[list[Pixel], Field(min_length=2, max_length=8)]
Text = Annotated[str, Field(max_length=200, pattern=r"^[^\x00-\x1f]*$")]


class Drag(BaseModel):
    """The body of a request to fit markings: 2 to 8 points [u, v] on each marking, in px of the
    whole picture."""

    model_config = ConfigDict(extra="forbid")

    left: Pixels
    right: Pixels
    curvature: Number | None = 0.0
    """Curvature, 1/m; None: it is fitted from a third point."""
    pitch_deg: Number | None = None
    """Pitch, degrees; None: it is fitted from the point where the markings meet."""


class Label(BaseModel):
    """The body of a request to save a picture's label: `ml` and `mr` in m, `angle` in rad,
    `curvature` in 1/m, `pitch_deg` in degrees. `heading` is "" if the class follows from the
    curvature. `drive` and `light`: cells of `labels.csv`; None leaves a cell as it is."""

    model_config = ConfigDict(extra="forbid")

    ml: Number
    mr: Number
    angle: Number
    curvature: Number = 0.0
    pitch_deg: Number = 0.0
    heading: Literal["", "left", "straight", "right", "?"] = ""
    drive: Text | None = None
    light: Text | None = None


class Labeller:
    """Answers the page's requests: lists and shows the pictures of a folder, and computes markings
    from a label, a model or dragged points."""

    def __init__(self, folder: LabelFolder, engine: Engine | None) -> None:
        """Label the pictures of `folder`. The model of `engine` proposes markings; with None it
        does not, and pictures without a label start with the markings of a usual lane."""
        self.folder = folder
        self._engine = engine
        self._lock = Lock()  # an engine takes one picture at a time

    def listing(self) -> dict[str, Any]:
        """Return the folder's name (`folder`), and for each picture its name and whether it has a
        label (`pictures`, a list of dicts with the keys `file` and `labelled`)."""
        rows = self.folder.rows()
        files = [
            {"file": name_as_text(name), "labelled": name in rows} for name in self.folder.files
        ]
        return {"folder": name_as_text(self.folder.folder.name), "pictures": files}

    def picture(self, number: int) -> dict[str, Any]:
        """Return what the page shows for picture `number`: name, size in px, row of `labels.csv`,
        version of the row (`row_version`), and the markings with their lines and handles in px
        (`shown`).

        The markings come from the label; without a label from the model's answer; if the model
        finds no lane either, they are the markings of a lane 3.6 m wide with the car in its middle.
        `source` states which of these three cases applies: "label", "model" or "usual". A label
        without a lane counts as no label here, and `note` describes this. `camera_pitch_deg` is the
        pitch in the camera file; the markings have the pitch in the row, if the row has one.
        `heading` is the class in the row; "" if it follows from the label's markings.
        """
        image = self.folder.picture(number)
        height, width = image.shape[:2]
        in_file = self.folder.camera(number, width, height)
        row = self.folder.rows().get(self.folder.files[number])
        pitch = (row or {}).get("pitch_deg")
        camera = replace(in_file, pitch_deg=float(pitch)) if pitch else in_file
        label = self.folder.markings(number, camera)
        answer, note = (None, "") if label else self._answer(image, camera)
        if row is not None and label is None:
            note = "the label has no lane; saving would replace it by the drawn lane"
        heading = (row or {}).get("heading", "")
        usual = Markings(*USUAL_LANE, camera.pitch_deg)
        return {
            "file": name_as_text(self.folder.files[number]),
            "width": width,
            "height": height,
            "camera_pitch_deg": in_file.pitch_deg,
            "row": row_as_text(row),
            "heading": "" if label and heading == heading_of(label) else heading,
            "version": row_version(row),
            "source": "label" if label else "model" if answer else "usual",
            "note": note,
            **shown(camera, label or answer or usual),
        }

    def _answer(
        self, image: np.ndarray[Any, Any], camera: CameraParameters
    ) -> tuple[Markings | None, str]:
        """Return the model's answer for a picture, None without one, and a note about it."""
        if self._engine is None:
            return None, ""
        lens = Rectification(camera, self._engine.card.camera)
        try:
            seen = lens.image(image)
        except ImageError as error:
            return None, str(error)
        with self._lock:
            outputs = self._engine(seen)
        found = decode_outputs(lens.outputs(outputs[None])[0])
        note = "unlike the training images" if found.out_of_distribution else ""
        sides = lane_sides(found.distances_m)
        if sides is None:
            return None, "the model sees no lane"
        return Markings(*sides, found.angle_rad, 0.0, camera.pitch_deg), note

    def shown_jpeg(self, number: int) -> bytes:
        """Return picture `number` as JPEG, reduced so that its longer side is at most 1600 px."""
        image = self.folder.picture(number)
        scale = min(1.0, MAX_SHOWN_PX / max(image.shape[:2]))
        if scale < 1:
            size = (round(image.shape[1] * scale), round(image.shape[0] * scale))
            image = cv2.resize(image, size, interpolation=cv2.INTER_AREA).astype(np.uint8)
        return bytes(simplejpeg.encode_jpeg(np.ascontiguousarray(image), quality=90))

    def fit(self, number: int, drag: Drag) -> dict[str, Any]:
        """Fit markings to the dragged points `drag` in picture `number`, and return them as JSON
        values with their lines and handles in px (`shown`). Raises UserError if no markings fit."""
        height, width = self.folder.picture(number).shape[:2]
        camera = self.folder.camera(number, width, height)
        found = fit_markings(camera, drag.left, drag.right, drag.curvature, drag.pitch_deg)
        return shown(camera, found)


def shown(camera: CameraParameters, markings: Markings) -> dict[str, Any]:
    """Convert markings to JSON values: a dict with the `markings` (m, rad, 1/m, degrees), and for
    "left" and "right" the pixels [u, v] of the `lines` to draw and of the `handles` to drag."""
    lines = {}
    for side, pixels in zip(("left", "right"), marking_pixels(camera, markings), strict=True):
        seen = pixels[np.isfinite(pixels).all(1) & (np.abs(pixels) < 1e5).all(1)]
        lines[side] = np.round(seen, 2).tolist()
    return {"markings": asdict(markings), "lines": lines, "handles": handles(camera, markings)}


def row_as_text(row: Cells | None) -> Cells | None:
    """Return the cells of a row as text that can be encoded (`name_as_text`); None for None."""
    return None if row is None else {name: name_as_text(text) for name, text in row.items()}


def create_app(labeller: Labeller, names: HostNames, token: str | None) -> Asgi:
    """Make the page and its interface as an ASGI application.

    `names`: allowed Host and Origin names; `token`: None if requests need no token.
    """
    app = FastAPI(openapi_url=None, docs_url=None, redoc_url=None)
    _answer_errors(app, labeller.folder.folder)
    last = len(labeller.folder.files) - 1
    number_type = Annotated[int, PathNumber(ge=0, le=last)]

    def get_pictures() -> Response:
        return JSONResponse(labeller.listing(), headers=HEADERS)

    def get_picture(number: int) -> Response:
        return JSONResponse(labeller.picture(number), headers=HEADERS)

    def get_image(number: int) -> Response:
        return Response(labeller.shown_jpeg(number), media_type="image/jpeg", headers=HEADERS)

    def post_fit(number: int, drag: Drag) -> Response:
        return JSONResponse(labeller.fit(number, drag), headers=HEADERS)

    def put_label(number: int, label: Label, version: str = "") -> Response:
        markings = Markings(label.ml, label.mr, label.angle, label.curvature, label.pitch_deg)
        texts = {"drive": label.drive, "light": label.light}
        given = {name: text.strip() for name, text in texts.items() if text is not None}
        row = labeller.folder.save(number, markings, label.heading, given, version)
        return changed(row)

    def delete_label(number: int, version: str = "") -> Response:
        labeller.folder.remove(number, version)
        return changed(None)

    def post_undo(number: int, version: str = "") -> Response:
        return changed(labeller.folder.undo(number, version))

    def changed(row: Cells | None) -> Response:
        told = {"row": row_as_text(row), "version": row_version(row)}
        return JSONResponse(told, headers=HEADERS)

    for work in (get_picture, get_image, post_fit, put_label, delete_label, post_undo):
        work.__annotations__["number"] = number_type
    app.get("/api/pictures")(get_pictures)
    app.get("/api/pictures/{number}")(get_picture)
    app.get("/api/pictures/{number}/image")(get_image)
    app.post("/api/pictures/{number}/fit")(post_fit)
    app.put("/api/pictures/{number}/label")(put_label)
    app.delete("/api/pictures/{number}/label")(delete_label)
    app.post("/api/pictures/{number}/label/undo")(post_undo)
    for path in sorted(PAGE.iterdir()):
        route = "/" if path.name == "index.html" else f"/{path.name}"
        app.get(route)(_page_file(path))
    return _checked(app, names, token)


def _answer_errors(app: FastAPI, folder: Path) -> None:
    """Make `app` answer a UserError, an OSError and a faulty request with one line of text,
    `detail`. The line names files without the path of `folder` on this machine."""

    def short(text: str) -> str:
        return name_as_text(text.replace(f"{folder}/", ""))

    @app.exception_handler(UserError)
    async def refuse(_request: Any, error: UserError) -> Response:
        status = 409 if isinstance(error, LabelChangedError) else 422
        return _refused(status, short(str(error)))

    @app.exception_handler(OSError)
    async def report(_request: Any, error: OSError) -> Response:
        return _refused(500, short(describe(error)))

    @app.exception_handler(RequestValidationError)
    async def refuse_form(_request: Any, error: RequestValidationError) -> Response:
        first = error.errors()[0]
        where = ".".join(map(str, first["loc"]))
        return _refused(422, f"{where}: {first['msg']}")


def _page_file(path: Path) -> Callable[[], Response]:
    def send() -> Response:
        return Response(path.read_bytes(), media_type=MEDIA_TYPES[path.suffix], headers=HEADERS)

    return send


def _checked(app: Asgi, names: HostNames, token: str | None) -> Asgi:
    """Return `app` with a check of every request before it (`_refusal`)."""

    async def run(scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            return  # there is no WebSocket: uvicorn answers 403
        answer = _refusal(scope, names, token) or app
        await answer(scope, receive, send)

    return run


def _refusal(scope: Scope, names: HostNames, token: str | None) -> Response | None:
    headers = dict(scope["headers"])
    count = sum(name == b"host" for name, _ in scope["headers"])
    host, origin = headers.get(b"host", b""), headers.get(b"origin")
    if count != 1:
        return _refused(400, "send one Host header")
    if not names.allow_host(host):
        return _refused(421, "this host name is not one of this page; use its address, or a token")
    if origin is not None and not names.allow_origin(origin, host):
        return _refused(403, "a page of another site may not use this one")
    if token is not None and scope["path"].startswith("/api/"):
        given = headers.get(b"authorization", b"")
        if not compare_digest(given, b"Bearer " + token.encode()):
            return _refused(401, "the token is missing or wrong")
    if scope["method"] in ("POST", "PUT"):
        if headers.get(b"content-type", b"").partition(b";")[0].strip() != b"application/json":
            return _refused(415, "send application/json")
        length = headers.get(b"content-length", b"")
        if not (length.isdigit() and int(length) <= MAX_BODY_BYTES):
            return _refused(413, f"send a body of at most {MAX_BODY_BYTES} bytes, with its length")
    return None


def _refused(status: int, detail: str) -> Response:
    return JSONResponse({"detail": detail}, status, HEADERS)


def serve_folder(labeller: Labeller, host: str, port: int, token: str | None) -> None:
    """Serve the page until Ctrl-C. Raises UserError when the address is not available."""
    names = HostNames([host], any_name=token is not None)
    app = create_app(labeller, names, token)
    with locked_folder(labeller.folder.folder):
        listeners = bind_all(host, port)
        for listener in listeners:  # before the address is printed, so that it answers at once
            listener.listen()
        where = address(listeners[0], host)
        hint, count = "" if token is None else "#TOKEN", len(labeller.folder.files)
        sys.stderr.write(f"{count} pictures; open {where}/{hint} and end with Ctrl-C\n")
        sys.stderr.flush()
        # A lifespan task that a second signal cancels would print a traceback.
        conf = uvicorn.Config(app, log_level="warning", access_log=False, ws="none", lifespan="off")
        server = uvicorn.Server(conf)
        if signal.getsignal(signal.SIGHUP) != signal.SIG_IGN:  # uvicorn handles the other signals
            signal.signal(signal.SIGHUP, lambda _, at: server.handle_exit(signal.SIGTERM, at))
        server.run(sockets=listeners)
