"""Dataclasses of a frame (an image to process) and of its result."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mtlnet.inference.prediction import Prediction
from trackfeatures.camera import CameraParameters

PixelReader = Callable[[CameraParameters], NDArray[np.uint8]]
"""Returns the pixels (height, width, 3) uint8 RGB in the view of the model's camera."""
ResultCallback = Callable[["FrameResult | Exception"], None]
"""Called once with the result of a frame, or with the error that ended it."""


@dataclass(frozen=True, slots=True)
class FrameResult:
    """The prediction for a frame, the members that identify model and engine, and the times in ms
    of waiting, decoding and the forward pass."""

    prediction: Prediction
    provenance: dict[str, str]
    queue_ms: float
    decode_ms: float
    forward_ms: float


@dataclass(frozen=True, slots=True)
class Frame:
    """An image to process. Times are in ns of the monotonic clock.

    `stream` is 0 for a frame without a stream. A `small` image is decoded in less time than the
    engine takes; `cost_ms` is the estimated decoding time. `source` is the image's camera if
    its pixels are warped into the view of the model's camera.
    """

    read: PixelReader
    stamp_ns: int
    stream: int = 0
    deadline_ns: int | None = None
    small: bool = False
    client: str = ""
    cost_ms: float = 0.0
    source: CameraParameters | None = None
