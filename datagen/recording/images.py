"""Encodes and decodes images: JPEG of quality 95 with 4:2:0 chroma, or lossless PNG."""

from struct import Struct

import numpy as np
from numpy.typing import NDArray

JPEG_QUALITY = 95
JPEG_MAGIC = b"\xff\xd8"
PNG_MAGIC = b"\x89PNG"
# Byte offset and layout of width and height in the header of a PNG file.
PNG_SIZE_AT, PNG_SIZE = 16, Struct(">II")

Buffer = bytes | memoryview


def encode(image: NDArray[np.uint8], codec: str) -> bytes:
    """Encode `image` (H, W, 3) uint8 RGB with `codec` ("jpeg" or "png")."""
    if codec == "jpeg":
        import simplejpeg

        contiguous = np.ascontiguousarray(image)
        return bytes(simplejpeg.encode_jpeg(contiguous, JPEG_QUALITY, "RGB", "420"))
    if codec != "png":
        raise ValueError(f"codec {codec!r}, not jpeg or png")
    import cv2

    done, data = cv2.imencode(".png", cv2.cvtColor(image, cv2.COLOR_RGB2BGR))
    if not done:
        raise ValueError(f"cannot write an image of shape {image.shape} as PNG")
    return data.tobytes()


def decode_into(data: Buffer, out: NDArray[np.uint8]) -> None:
    """Decode a JPEG or PNG into `out` (H, W, 3) uint8 RGB, contiguous.

    Raises ValueError for a damaged image, another format or another size. libjpeg-turbo decodes
    JPEG files.
    """
    if data[:2] == JPEG_MAGIC:
        import simplejpeg

        # The decoder refuses a buffer that is too small, but not one that is too large.
        height, width = simplejpeg.decode_jpeg_header(data)[:2]
        _require_shape((height, width), out)
        simplejpeg.decode_jpeg(data, "RGB", buffer=out)
    elif bytes(data[:4]) == PNG_MAGIC:
        import cv2

        # OpenCV would allocate an image of any size that the header declares.
        _require_shape(_png_size(data), out)
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
        if image is None:
            raise ValueError("the PNG cannot be decoded")
        _require_shape(image.shape[:2], out)
        cv2.cvtColor(image, cv2.COLOR_BGR2RGB, dst=out)
    else:
        raise ValueError(f"neither JPEG nor PNG: it starts with {bytes(data[:4])!r}")


def _png_size(data: Buffer) -> tuple[int, int]:
    """Read (height, width) in px from the header of a PNG. Raises ValueError if it is cut."""
    if len(data) < PNG_SIZE.size + PNG_SIZE_AT:
        raise ValueError("the PNG ends within its header")
    width, height = PNG_SIZE.unpack_from(data, PNG_SIZE_AT)
    return height, width


def _require_shape(found: tuple[int, ...], out: NDArray[np.uint8]) -> None:
    if tuple(found) != out.shape[:2]:
        raise ValueError(
            f"it is {found[1]}x{found[0]} px, expected {out.shape[1]}x{out.shape[0]} px"
        )
