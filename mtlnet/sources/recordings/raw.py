"""Converts raw pictures of ROS and Foxglove messages to RGB. Samples of 16 bits are reduced to 8.

Sources: ROS `sensor_msgs/image_encodings.hpp`, Foxglove's schema `RawImage`.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from mtlnet.inference.image_decoding.decode import check_file_size
from mtlnet.inference.image_decoding.errors import Fault, ImageError

Image = NDArray[np.uint8]


@dataclass(frozen=True, slots=True)
class Layout:
    """Layout of the pixels in an encoding of raw pictures: samples per pixel, bytes per sample, and
    OpenCV's code for the conversion to RGB (None: no conversion)."""

    samples: int
    bytes: int
    conversion: int | None


LAYOUTS = {
    "rgb8": Layout(3, 1, None),
    "bgr8": Layout(3, 1, cv2.COLOR_BGR2RGB),
    "8UC3": Layout(3, 1, cv2.COLOR_BGR2RGB),  # BGR in the viewers of ROS and Foxglove
    "rgba8": Layout(4, 1, cv2.COLOR_RGBA2RGB),
    "bgra8": Layout(4, 1, cv2.COLOR_BGRA2RGB),
    "8UC4": Layout(4, 1, cv2.COLOR_BGRA2RGB),
    "rgb16": Layout(3, 2, None),
    "bgr16": Layout(3, 2, cv2.COLOR_BGR2RGB),
    "mono8": Layout(1, 1, cv2.COLOR_GRAY2RGB),
    "8UC1": Layout(1, 1, cv2.COLOR_GRAY2RGB),
    "mono16": Layout(1, 2, cv2.COLOR_GRAY2RGB),
    "uyvy": Layout(2, 1, cv2.COLOR_YUV2RGB_UYVY),
    "yuv422": Layout(2, 1, cv2.COLOR_YUV2RGB_UYVY),
    "yuyv": Layout(2, 1, cv2.COLOR_YUV2RGB_YUYV),
    "yuv422_yuy2": Layout(2, 1, cv2.COLOR_YUV2RGB_YUYV),
}
for _order in ("RGGB", "BGGR", "GBRG", "GRBG"):
    for _bits in (8, 16):
        LAYOUTS[f"bayer_{_order.lower()}{_bits}"] = Layout(
            1, _bits // 8, getattr(cv2, f"COLOR_Bayer{_order}2RGB")
        )


def decode_raw(
    data: NDArray[np.uint8], encoding: str, width: int, height: int, step: int, *, big_endian: bool
) -> Image:
    """Convert the raw picture in `data` to uint8 RGB (height, width, 3).

    `encoding`: name of the pixel layout, such as "bgr8". `step`: bytes per row, with padding; 0:
    rows without padding. `big_endian`: byte order of samples of 16 bits. Raises ImageError for an
    unsupported encoding, or too little data.
    """
    layout = LAYOUTS.get(encoding)
    if layout is None:
        depth = " (of depths or measurements)" if encoding.startswith(("16", "32", "64")) else ""
        raise ImageError(
            Fault.UNSUPPORTED,
            f"its encoding {encoding!r}{depth} is not supported; supported are "
            f"{', '.join(sorted(LAYOUTS))}",
        )
    check_file_size(width, height)
    if layout.samples == 2 and width % 2:
        raise ImageError(
            Fault.UNSUPPORTED,
            f"its width of {width} px is odd, and two pixels of {encoding} share their colour",
        )
    row = width * layout.samples * layout.bytes
    step = step or row
    if step < row or len(data) < step * (height - 1) + row:
        raise ImageError(
            Fault.DAMAGED,
            f"{len(data)} bytes in rows of {step} do not hold {width} x {height} px of {encoding}; "
            f"{row * height} bytes in rows of {row} are needed",
        )
    rows = np.lib.stride_tricks.as_strided(data, (height, row), (step, 1))
    return _to_rgb(rows, layout, width, big_endian)


def _to_rgb(rows: NDArray[np.uint8], layout: Layout, width: int, big_endian: bool) -> Image:
    if layout.bytes == 2:  # the high byte of each sample
        rows = rows[:, 0 if big_endian else 1 :: 2]
    image = np.ascontiguousarray(rows).reshape(len(rows), width, layout.samples)
    if layout.conversion is None:
        return image
    return cv2.cvtColor(image, layout.conversion).astype(np.uint8, copy=False)
