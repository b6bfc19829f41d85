"""The work that each peer does for a request, with the engine, the precision and the answer of our
service."""

import os
from pathlib import Path
from typing import Any

import simplejpeg

from mtlnet.inference.engine import load_engine
from mtlnet.inference.prediction import decode_outputs

MODEL, WORKERS, PORT = "DRIVERVIEW_MODEL", "DRIVERVIEW_WORKERS", "DRIVERVIEW_PORT"


class Work:
    """Decodes a JPEG, runs the model in the folder $DRIVERVIEW_MODEL and returns the answer."""

    def __init__(self) -> None:
        self._engine = load_engine(Path(os.environ[MODEL]))

    def __call__(self, body: bytes) -> dict[str, Any]:
        image = simplejpeg.decode_jpeg(body, colorspace="RGB")
        return decode_outputs(self._engine(image)).as_json()


def workers() -> int:
    """Return the number of worker processes, from $DRIVERVIEW_WORKERS."""
    return int(os.environ[WORKERS])


def port() -> int:
    """Return the port of the server on 127.0.0.1, from $DRIVERVIEW_PORT."""
    return int(os.environ[PORT])
