"""Image files for tests: JPEG and PNG files of a smooth picture, also with an Exif orientation."""

import struct
import zlib
from typing import Any

import cv2
import numpy as np
import simplejpeg
from numpy.typing import NDArray

Pixels = NDArray[np.uint8]


def picture(width: int = 280, height: int = 210, channels: int = 3) -> Pixels:
    """A smooth image (height, width, channels): a gradient in each channel."""
    x, y = np.meshgrid(np.linspace(0, 200, width), np.linspace(0, 50, height))
    planes = [(x + y * (1 + c)) % 256 for c in range(channels)]
    return np.stack(planes, axis=2).astype(np.uint8)


def jpeg(image: Pixels, colours: str = "RGB") -> bytes:
    """A JPEG file of `image`, which is RGB or grey."""
    subsampling = "444" if colours == "RGB" else "Gray"
    return bytes(simplejpeg.encode_jpeg(np.ascontiguousarray(image), 95, colours, subsampling))


def png(image: NDArray[Any], *options: int) -> bytes:
    """A PNG file of `image`, which has OpenCV's channel order (BGR, BGRA or grey)."""
    done, data = cv2.imencode(".png", np.ascontiguousarray(image), list(options))
    assert done
    return bytes(data.tobytes())


def chunk(kind: bytes, data: bytes) -> bytes:
    """A chunk of a PNG file."""
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def segment(content: bytes, marker: int = 0xE1) -> bytes:
    """A segment of a JPEG file."""
    return bytes((0xFF, marker)) + struct.pack(">H", len(content) + 2) + content


def exif(orientation: int, order: str = ">", kind: int = 3, count: int = 1) -> bytes:
    """An Exif block with a maker tag before the orientation, and another orientation in the
    thumbnail's directory."""
    mark = b"MM" if order == ">" else b"II"
    value = struct.pack(order + ("I" if kind == 4 else "HH"), *([orientation] + [0] * (kind != 4)))
    maker = struct.pack(order + "HHI4s", 0x010F, 2, 4, b"Cam\0")
    entry = struct.pack(order + "HHI", 0x0112, kind, count) + value
    thumbnail = struct.pack(order + "HHHIHHI", 1, 0x0112, 3, 1, 5, 0, 0)
    first = struct.pack(order + "H", 2) + maker + entry + struct.pack(order + "I", 38)
    return mark + struct.pack(order + "HI", 42, 8) + first + thumbnail


def in_jpeg(image: Pixels, block: bytes, *before: bytes) -> bytes:
    """A JPEG file with this Exif block, behind the segments `before`."""
    body = jpeg(image)
    return body[:2] + b"".join(before) + segment(b"Exif\0\0" + block) + body[2:]


def in_png(image: Pixels, block: bytes, *, at_end: bool = False) -> bytes:
    """A PNG file with this Exif block, before the pixels or behind them."""
    body = png(image[:, :, ::-1])
    place = len(body) - 12 if at_end else 33
    return body[:place] + chunk(b"eXIf", block) + body[place:]
