"""From an image file's bytes to the model's input: limits, header, strict decoding, scaling.

Used by `mtlnet predict` and `serve`, which so get the same pixels. The size is read from the header
before decoding: a PNG of 31 KB can need 1.5 GB. A wider image is cropped to the model's field of
view (`mtlnet.inference.image_decoding.crop`). EXIF orientation is ignored, alpha is dropped, grey
becomes RGB, 16 bits become 8.
"""

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import simplejpeg
from numpy.typing import NDArray

from mtlnet.inference.image_decoding import jpeg_structure as jpeg
from mtlnet.inference.image_decoding import png_structure as png
from mtlnet.inference.image_decoding.crop import crop_box
from mtlnet.inference.image_decoding.errors import Fault, ImageError
from trackfeatures.camera import CameraParameters
from trackfeatures.errors import UserError

MAX_FILE_BYTES = 32 << 20
MIN_SIDE_PX, MAX_SIDE_PX, MAX_PIXELS = 16, 4096, 8_400_000
MAX_SCANNED_PX = 100_000_000  # pixels times scans of a JPEG: ten scans of the largest image
LATE_CHECK_BYTES = 1 << 18  # a JPEG file of more is checked when it is decoded, not by `inspect`
# One 2.6 GHz core: a PNG of 64 bits a pixel 84 ns a pixel, a baseline JPEG 10, of ten scans 15.
PNG_NS_PER_BIT, PNG_NS_PER_BYTE, JPEG_NS, SCAN_NS, PROGRESSIVE_SCANS = 1.4, 2.0, 10.0, 1.0, 10
MAX_SEQUENTIAL_SCANS = 4  # one for each component
MAX_TRAILING_BYTES = 64  # padding of some cameras; more could be another file


@dataclass(frozen=True, slots=True)
class ImageHeader:
    """Size of an image, px; `png_header` is set for a PNG.

    `scans`: of a JPEG; where it was not `checked`, the usual number of such a JPEG.
    """

    width: int
    height: int
    png_header: png.PngHeader | None = None
    scans: int = 1
    checked: bool = True

    @property
    def decode_ms(self) -> float:
        """An estimate of the time to decode it on one core, ms."""
        if (found := self.png_header) is not None:
            per_pixel_ns = PNG_NS_PER_BIT * max(8, found.pixel_bits)
            per_pixel_ns += PNG_NS_PER_BYTE * found.file_bytes / (self.width * self.height)
        else:
            per_pixel_ns = JPEG_NS + SCAN_NS * (self.scans - 1)
        return self.width * self.height * per_pixel_ns / 1e6


def read_image(
    path: Path, view: CameraParameters, fov_y_deg: float | None = None
) -> NDArray[np.uint8]:
    """The JPEG or PNG at `path` as uint8 RGB (view.height, view.width, 3).

    It is scaled, and cropped if wider than the view; `fov_y_deg` as in `inspect`. Raises ImageError
    for an image that cannot be used, UserError for a missing or too large file.
    """
    body = _read_file(path)
    try:
        return decode(body, inspect(body, view, fov_y_deg), view, fov_y_deg)
    except ImageError as error:
        raise ImageError(error.fault, f"{path}: {error}") from error


def read_whole_image(path: Path) -> NDArray[np.uint8]:
    """The JPEG or PNG at `path` as uint8 RGB (H, W, 3), of any size within the limits.

    Raises as `read_image`.
    """
    body = _read_file(path)
    try:
        return _decode_whole(body, _read_header(body))
    except ImageError as error:
        raise ImageError(error.fault, f"{path}: {error}") from error


def _read_file(path: Path) -> bytes:
    if not path.is_file():
        raise UserError(f"there is no image file {path}")
    if path.stat().st_size > MAX_FILE_BYTES:
        raise UserError(
            f"{path} has {path.stat().st_size} bytes, at most {MAX_FILE_BYTES} are read; save a "
            "smaller image"
        )
    return path.read_bytes()


def inspect(body: bytes, view: CameraParameters, fov_y_deg: float | None = None) -> ImageHeader:
    """The header of an image, checked against all limits before decoding.

    Takes a few ms at most: what takes longer is left to `decode`.

    `fov_y_deg`: the image's vertical field of view, None: that of `view`. Raises ImageError.
    """
    header = _read_header(body)
    crop_box(header.width, header.height, view, fov_y_deg)
    return header


def _read_header(body: bytes) -> ImageHeader:
    """The header of an image within the limits. Raises ImageError."""
    if body.startswith(png.SIGNATURE):
        found = png.read_header(body)
        header = ImageHeader(found.width, found.height, found)
    elif body.startswith(jpeg.SIGNATURE):
        header = _inspect_jpeg(body)
    else:
        seen = f"{len(body)} bytes that begin with {body[:8]!r}" if body else "nothing at all"
        raise ImageError(Fault.NOT_AN_IMAGE, f"no JPEG or PNG file, but {seen}")
    check_size(header.width, header.height)
    return header


def _inspect_jpeg(body: bytes) -> ImageHeader:
    is_large = len(body) > LATE_CHECK_BYTES
    # First, as it refuses many segments, over which the decoder's reader would take 20 ms.
    is_progressive = is_large and jpeg.is_progressive(body)
    try:
        # The decoder's own header reader, so that sizes cannot differ from the decoded image.
        height, width, colours, _ = simplejpeg.decode_jpeg_header(body)
    except ValueError as error:
        raise _damaged_jpeg(error) from error
    if colours not in ("Gray", "YCbCr", "RGB"):
        raise ImageError(Fault.UNSUPPORTED, f"the JPEG's colours are {colours}; save it in RGB")
    if is_large:
        scans = PROGRESSIVE_SCANS if is_progressive else 1
        return ImageHeader(width, height, scans=scans, checked=False)
    return ImageHeader(width, height, scans=_check_jpeg(body, width, height))


def _check_jpeg(body: bytes, width: int, height: int) -> int:
    """The number of scans of a JPEG whose structure is sound. Raises ImageError."""
    structure = jpeg.read_structure(body)
    check_trailing(len(body) - structure.length)
    if structure.scans * width * height > MAX_SCANNED_PX:
        raise ImageError(
            Fault.UNSUPPORTED,
            f"the JPEG has {structure.scans} scans of {width} x {height} px, at most "
            f"{MAX_SCANNED_PX / 1e6:g} million px in all are decoded; save it as baseline JPEG",
        )
    return structure.scans


def _check_late(body: bytes, header: ImageHeader) -> None:
    """Check what `inspect` left. Raises ImageError, also where the estimate was too low."""
    scans = _check_jpeg(body, header.width, header.height)
    if header.scans == 1 and scans > MAX_SEQUENTIAL_SCANS:
        raise ImageError(
            Fault.UNSUPPORTED,
            f"the JPEG has {scans} scans, a sequential one has {MAX_SEQUENTIAL_SCANS} at most; "
            "save it anew",
        )


def check_trailing(count: int) -> None:
    """Raise ImageError when more than `MAX_TRAILING_BYTES` follow the end of the image."""
    if count > MAX_TRAILING_BYTES:
        raise ImageError(
            Fault.TRAILING,
            f"{count} bytes follow the end of the image, at most {MAX_TRAILING_BYTES} are "
            "accepted; send the image alone",
        )


def check_size(width: int, height: int) -> None:
    """Raise ImageError unless an image of that size (px) is within the limits."""
    sides = min(width, height) >= MIN_SIDE_PX and max(width, height) <= MAX_SIDE_PX
    if not sides or width * height > MAX_PIXELS:
        raise ImageError(
            Fault.SIZE,
            f"the image is {width} x {height} px; {MIN_SIDE_PX} to {MAX_SIDE_PX} px a side and at "
            f"most {MAX_PIXELS / 1e6:.1f} million px are accepted: scale it to the model's camera",
        )


def decode(
    body: bytes, header: ImageHeader, view: CameraParameters, fov_y_deg: float | None = None
) -> NDArray[np.uint8]:
    """The image as uint8 RGB (view.height, view.width, 3), cropped and area-averaged to it.

    `header` and `fov_y_deg` as in `inspect`. Raises ImageError.
    """
    return crop_and_resize(_decode_whole(body, header), view, fov_y_deg)


def _decode_whole(body: bytes, header: ImageHeader) -> NDArray[np.uint8]:
    if header.png_header is not None:
        image = _decode_png(body, header.png_header)
    else:
        if not header.checked:
            _check_late(body, header)
        image = _decode_jpeg(body)
    if image.shape != (header.height, header.width, 3):
        raise ImageError(
            Fault.DAMAGED,
            f"the image decodes to {image.shape[1]} x {image.shape[0]} px, its header declares "
            f"{header.width} x {header.height}; save it anew",
        )
    return image


def crop_and_resize(
    image: NDArray[np.uint8], view: CameraParameters, fov_y_deg: float | None = None
) -> NDArray[np.uint8]:
    """An image (H, W, 3) cropped and scaled to (view.height, view.width, 3). Raises ImageError."""
    box = crop_box(image.shape[1], image.shape[0], view, fov_y_deg)
    if box is not None:
        image = image[box.top : box.top + box.height, box.left : box.left + box.width]
    if image.shape[:2] == (view.height, view.width):
        return np.ascontiguousarray(image)
    method = cv2.INTER_AREA if image.shape[1] > view.width else cv2.INTER_LINEAR
    scaled = cv2.resize(image, (view.width, view.height), interpolation=method)
    return scaled.astype(np.uint8, copy=False)


def _decode_jpeg(body: bytes) -> NDArray[np.uint8]:
    try:
        image: NDArray[np.uint8] = simplejpeg.decode_jpeg(body, colorspace="RGB", strict=True)
    except ValueError as error:
        raise _damaged_jpeg(error) from error
    return image


def _decode_png(body: bytes, header: png.PngHeader) -> NDArray[np.uint8]:
    checked, end = png.critical_chunks(body, header)
    check_trailing(len(body) - end)
    image = cv2.imdecode(np.frombuffer(checked, np.uint8), cv2.IMREAD_COLOR)
    if image is None:
        raise ImageError(Fault.DAMAGED, "the PNG cannot be decoded; save it anew")
    return cv2.cvtColor(image, cv2.COLOR_BGR2RGB).astype(np.uint8, copy=False)


def _damaged_jpeg(error: ValueError) -> ImageError:
    return ImageError(Fault.DAMAGED, f"the JPEG cannot be decoded ({error}); give the whole file")
