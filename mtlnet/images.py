"""Images from files, made to fit a model's camera."""

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from mtlnet.card import Camera
from trackfeatures.errors import UserError

MAX_BYTES = 32 << 20
ASPECT_TOLERANCE = 0.01
SIGNATURES = {b"\xff\xd8\xff": "JPEG", b"\x89PNG\r\n\x1a\n": "PNG"}


class ImageError(UserError):
    """A file that is no image this model can read."""


def read_image(path: Path, camera: Camera) -> NDArray[np.uint8]:
    """The JPEG or PNG at `path` as RGB (height, width, 3) of `camera`'s size.

    Another size is scaled; another shape is refused, for its angles would be wrong.
    Raises ImageError.
    """
    if not path.is_file():
        raise ImageError(f"there is no image file {path}")
    if path.stat().st_size > MAX_BYTES:
        raise ImageError(f"{path} has {path.stat().st_size} bytes, at most {MAX_BYTES} are read")
    content = path.read_bytes()
    if not any(content.startswith(signature) for signature in SIGNATURES):
        raise ImageError(
            f"{path} is no JPEG or PNG image (it begins with {content[:8]!r}); convert it first"
        )
    decoded = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_COLOR_RGB)
    if decoded is None:
        raise ImageError(f"{path} is damaged: it cannot be decoded")
    height, width = decoded.shape[:2]
    if abs(width / height * camera.height / camera.width - 1) > ASPECT_TOLERANCE:
        raise ImageError(
            f"{path} is {width} x {height}; the model sees {camera.width} x {camera.height} and "
            "takes other sizes of the same shape only: crop it to that shape"
        )
    image: NDArray[np.uint8] = np.asarray(decoded, np.uint8)
    if (width, height) != (camera.width, camera.height):
        size = (camera.width, camera.height)
        image = np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)
    return np.ascontiguousarray(image)
