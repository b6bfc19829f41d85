"""Dataclasses of a frame (an image to process) and of its result."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mtlnet.inference.prediction import Prediction
from serve.scheduling.loaded_engine import LoadedEngine

PixelReader = Callable[[LoadedEngine], NDArray[np.uint8]]
"""Called with the engine that will process the pixels; returns the image's pixels (height, width,
3), uint8 RGB, in the view of the model's camera."""
ResultCallback = Callable[["FrameResult | Exception"], None]
"""Called once with the result of a frame, or with the error that ended it."""


@dataclass(frozen=True, slots=True)
class FrameResult:
    """The prediction for a frame, and the times in ms of waiting, decoding and the forward pass.

    `provenance`: the members of the answer that identify the model and the engine.
    """

    prediction: Prediction
    provenance: dict[str, str]
    queue_ms: float
    decode_ms: float
    forward_ms: float


@dataclass(frozen=True, slots=True)
class Frame:
    """An image to process. `read` returns its pixels.

    `stamp_ns`: time at which the request began; `deadline_ns`: time until which the processing must
    begin; both in ns of the monotonic clock. `stream`: key of the stream, 0 for a frame without a
    stream. `client`: address of the client. `cost_ms`: estimated decoding time in ms; for a `small`
    image it is shorter than the forward pass of the network. `camera`: the name of the image's
    camera if `read` warps the pixels into the view of the model's camera, else None.
    """

    read: PixelReader
    stamp_ns: int
    stream: int = 0
    deadline_ns: int | None = None
    small: bool = False
    client: str = ""
    cost_ms: float = 0.0
    camera: str | None = None
