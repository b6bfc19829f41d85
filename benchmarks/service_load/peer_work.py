"""Answers a JPEG in each peer with the same engine, precision and answer as in our service."""

import os
from pathlib import Path
from typing import Any

import simplejpeg

from mtlnet.inference.engine import load_engine
from mtlnet.inference.prediction import decode_outputs

MODEL, WORKERS, PORT = "DRIVERVIEW_MODEL", "DRIVERVIEW_WORKERS", "DRIVERVIEW_PORT"


class Work:
    """The model of the environment's run, on one thread."""

    def __init__(self) -> None:
        self._engine = load_engine(Path(os.environ[MODEL]))

    def __call__(self, body: bytes) -> dict[str, Any]:
        image = simplejpeg.decode_jpeg(body, colorspace="RGB")
        return decode_outputs(self._engine(image)).as_json()


def workers() -> int:
    """How many processes are to run the model."""
    return int(os.environ[WORKERS])


def port() -> int:
    """Where to listen, on this machine alone."""
    return int(os.environ[PORT])
