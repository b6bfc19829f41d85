"""A folder of drawn pictures of a known camera, and the label page that serves it."""

import http.client
import json
import threading
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import uvicorn

from mtlnet.label.folder import LabelFolder
from mtlnet.label.geometry import Markings, marking_pixels
from mtlnet.label.server import Labeller, create_app
from runtime.access import HostNames
from runtime.sockets import bind
from trackfeatures.camera import CameraParameters

CAMERA = "{width: 640, height: 360, fov_y_deg: 40, x: 0.0, height_above_road_m: 1.22}\n"
TRUE = Markings(-1.5, 2.1, 0.03, 0.0, 0.5)


def draw(path: Path, camera: CameraParameters, markings: Markings = TRUE) -> None:
    """A picture with both markings of a lane in white."""
    image = np.full((camera.height, camera.width, 3), 70, np.uint8)
    for line in marking_pixels(camera, markings):
        seen = np.round(line[np.isfinite(line).all(1)]).astype(np.int32)
        cv2.polylines(image, [seen], False, (255, 255, 255), 3)
    cv2.imwrite(str(path), image)


@dataclass
class Site:
    """The page at a port of this machine."""

    folder: Path
    port: int
    headers: dict[str, str] = field(default_factory=dict)

    def ask(
        self, method: str, path: str, body: Any = None, **headers: str
    ) -> tuple[int, Any, dict[str, str]]:
        """Status, body (of JSON: its value) and headers of an answer."""
        connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=60)
        sent = {**self.headers, **{k.replace("_", "-"): v for k, v in headers.items()}}
        data = None
        if body is not None:
            sent.setdefault("Content-Type", "application/json")
            data = body if isinstance(body, bytes) else json.dumps(body).encode()
        connection.request(method, path, data, sent)
        answer = connection.getresponse()
        content = answer.read()
        found = {name.lower(): value for name, value in answer.getheaders()}
        connection.close()
        if found.get("content-type", "").startswith("application/json"):
            return answer.status, json.loads(content), found
        return answer.status, content, found


@pytest.fixture
def pictures(tmp_path: Path) -> Path:
    """Three pictures, one in a folder of its own."""
    folder = tmp_path / "mine"
    (folder / "sub").mkdir(parents=True)
    (folder / "camera.yaml").write_text(CAMERA)
    camera = CameraParameters(width=640, height=360, fov_y_deg=40, x=0.0, z=0.97)
    for name in ("1.png", "sub/2.png", "10.png"):
        draw(folder / name, camera)
    return folder


@pytest.fixture
def site(pictures: Path) -> Iterator[Site]:
    yield from serve(pictures, None)


@pytest.fixture
def guarded(pictures: Path) -> Iterator[Site]:
    """With a token."""
    yield from serve(pictures, "a-token-of-sixteen")


def serve(folder: Path, token: str | None) -> Iterator[Site]:
    labeller = Labeller(LabelFolder(folder, None, CameraParameters()), None)
    app = create_app(labeller, HostNames(["127.0.0.1"], any_name=token is not None), token)
    listener = bind("127.0.0.1", 0)
    listener.listen(16)
    server = uvicorn.Server(uvicorn.Config(app, log_level="error", ws="none", lifespan="off"))
    thread = threading.Thread(target=server.run, kwargs={"sockets": [listener]})
    thread.start()
    try:
        yield Site(folder, listener.getsockname()[1])
    finally:
        server.should_exit = True
        thread.join()
