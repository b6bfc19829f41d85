"""Decodes image files to the model's input: checks the limits and the header, decodes, scales.

`mtlnet predict`, `train`, `evaluate` and `serve` use this module, so that all get the same pixels.
The size is read from the header before decoding, because a PNG of 31 KB can need 1.5 GB. The image
is rotated upright by its orientation (EXIF; `eXIf` in a PNG); every size and crop refers to the
upright image. A wider image is cropped to the model's field of view
(`mtlnet.inference.image_decoding.crop`). Alpha is dropped, grey becomes RGB, samples of 16 bits are
reduced to 8.

The service accepts JPEG and PNG (`read_header`, `decode_whole`). A file on this machine can be of
another kind and have up to 1 GiB and 256 million px (`read_whole_image`, `decode_file`).
"""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import simplejpeg
from numpy.typing import NDArray

from mtlnet.inference.image_decoding import jpeg_structure as jpeg
from mtlnet.inference.image_decoding import other_kinds
from mtlnet.inference.image_decoding import png_structure as png
from mtlnet.inference.image_decoding.crop import crop_box
from mtlnet.inference.image_decoding.errors import Fault, ImageError
from mtlnet.inference.image_decoding.orientation import (
    NONE,
    exif_orientation,
    swaps_sides,
    upright,
)
from trackfeatures.camera import CameraParameters
from trackfeatures.errors import UserError

MAX_FILE_BYTES = 1 << 30
# Limit for a file on this machine, 0.8 GB of pixels; the largest sensors have 200 million.
MAX_FILE_PIXELS = 256_000_000
MIN_SIDE_PX, MAX_SIDE_PX, MAX_PIXELS = 16, 4096, 8_400_000
MAX_SCANNED_PX = 100_000_000  # pixels times scans of a JPEG: ten scans of the largest image
LATE_CHECK_BYTES = 1 << 18  # larger JPEG files are checked by `decode_whole`
# Measured on one core at 2.6 GHz, ns per pixel: 84 for a PNG with 64 bits per pixel, 10 for a
# baseline JPEG, 15 for a JPEG with ten scans.
PNG_NS_PER_BIT, PNG_NS_PER_BYTE, JPEG_NS, SCAN_NS, PROGRESSIVE_SCANS = 1.4, 2.0, 10.0, 1.0, 10
TURN_NS = 6.0  # time to rotate a pixel
MAX_SEQUENTIAL_SCANS = 4  # one for each component
MAX_TRAILING_BYTES = 64  # some cameras add padding; more bytes could be another file


@dataclass(frozen=True, slots=True)
class ImageHeader:
    """Header of an image: `width` and `height` of the upright image, px.

    `png_header` is set for a PNG. `scans`: number of scans of a JPEG; as long as its structure is
    not `checked`, the usual number for a JPEG of its kind. `orientation`: as in EXIF, 1 to 8.
    """

    width: int
    height: int
    png_header: png.PngHeader | None = None
    scans: int = 1
    checked: bool = True
    orientation: int = NONE

    @property
    def decode_ms(self) -> float:
        """Estimated time to decode the image on one core, ms."""
        if (found := self.png_header) is not None:
            per_pixel_ns = PNG_NS_PER_BIT * max(8, found.pixel_bits)
            per_pixel_ns += PNG_NS_PER_BYTE * found.file_bytes / (self.width * self.height)
        else:
            per_pixel_ns = JPEG_NS + SCAN_NS * (self.scans - 1)
        if self.orientation != NONE:
            per_pixel_ns += TURN_NS
        return self.width * self.height * per_pixel_ns / 1e6


def read_whole_image(path: Path) -> NDArray[np.uint8]:
    """Read the image file at `path`; returns upright uint8 RGB (H, W, 3).

    Raises ImageError for an image that cannot be used, UserError for a file that is missing or too
    large.
    """
    with _named(path):
        return decode_file(_read_file(path))


@contextmanager
def _named(path: Path) -> Iterator[None]:
    """Add the file's name to an ImageError that is raised within the context."""
    try:
        yield
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


def decode_file(body: bytes) -> NDArray[np.uint8]:
    """Decode the bytes `body` of an image file on this machine; returns upright uint8 RGB (H, W,
    3).

    Raises ImageError for an image that cannot be used.
    """
    if body.startswith(png.SIGNATURE):
        header = png.read_header(body)
        check_file_size(header.width, header.height)
        image = _decode_png(body, header, limited=False)
        return upright(image, exif_orientation(png.find_exif(body, limited=False)))
    if body.startswith(jpeg.SIGNATURE):
        check_file_size(*_jpeg_size(body)[:2])
        return upright(_decode_padded_jpeg(body), jpeg.read_head(body).orientation)
    kind = other_kinds.find_kind(body)
    if kind is None:
        raise ImageError(
            Fault.NOT_AN_IMAGE,
            f"no image file ({other_kinds.READ} are read), but {other_kinds.describe(body)}",
        )
    width, height, orientation = other_kinds.read_header(body, kind)
    check_file_size(width, height)
    return other_kinds.decode(body, kind, orientation)


def check_file_size(width: int, height: int) -> None:
    """Raise ImageError unless an image of this size (px) may be read from a file on this machine:
    at least 16 px a side and at most 256 million px."""
    if min(width, height) < MIN_SIDE_PX or width * height > MAX_FILE_PIXELS:
        raise ImageError(
            Fault.SIZE,
            f"the image is {width} x {height} px; {MIN_SIDE_PX} px a side at least and "
            f"{MAX_FILE_PIXELS / 1e6:.0f} million px at most are read: give it in another size",
        )


def read_header(body: bytes) -> ImageHeader:
    """Read the header of an image sent to the service, and check it against the service's limits.

    This takes at most a few ms; slower checks are left to `decode_whole`. Raises ImageError for an
    image that is not accepted.
    """
    if body.startswith(png.SIGNATURE):
        found = png.read_header(body)
        orientation = exif_orientation(png.find_exif(body))
        width, height = _upright_size(found.width, found.height, orientation)
        header = ImageHeader(width, height, found, orientation=orientation)
    elif body.startswith(jpeg.SIGNATURE):
        header = _inspect_jpeg(body)
    else:
        raise ImageError(
            Fault.NOT_AN_IMAGE, f"no JPEG or PNG file, but {other_kinds.describe(body)}"
        )
    check_size(header.width, header.height)
    return header


def _upright_size(width: int, height: int, orientation: int) -> tuple[int, int]:
    """Return width and height (px) of the upright image."""
    return (height, width) if swaps_sides(orientation) else (width, height)


def _inspect_jpeg(body: bytes) -> ImageHeader:
    is_large = len(body) > LATE_CHECK_BYTES
    # The head is read first, because the decoder can take 20 ms for many segments or a large
    # colour profile.
    head = jpeg.read_head(body) if is_large else None
    width, height, colours = _jpeg_size(body if head is None else head.description)
    if colours not in ("Gray", "YCbCr", "RGB"):
        raise ImageError(Fault.UNSUPPORTED, f"the JPEG's colours are {colours}; save it in RGB")
    if head is not None:
        orientation, checked = head.orientation, False
        scans = PROGRESSIVE_SCANS if head.is_progressive else 1
    else:
        structure = _check_jpeg(body, width, height)
        orientation, checked, scans = structure.orientation, True, structure.scans
    width, height = _upright_size(width, height, orientation)
    return ImageHeader(width, height, None, scans, checked, orientation)


def _jpeg_size(body: bytes) -> tuple[int, int, str]:
    """Return the stored width and height, px, and the colour space. Raises ImageError for a damaged
    header."""
    try:
        # The decoder's own header reader, so that sizes cannot differ from the decoded image.
        height, width, colours, _ = simplejpeg.decode_jpeg_header(body)
    except ValueError as error:
        raise _damaged_jpeg(error) from error
    return width, height, colours


def _check_jpeg(body: bytes, width: int, height: int) -> jpeg.JpegStructure:
    """Return the structure of a JPEG of `width` x `height` px. Raises ImageError for a damaged
    JPEG, bytes after the image, or too many scans."""
    structure = jpeg.read_structure(body)
    check_trailing(len(body) - structure.length)
    if structure.scans * width * height > MAX_SCANNED_PX:
        raise ImageError(
            Fault.UNSUPPORTED,
            f"the JPEG has {structure.scans} scans of {width} x {height} px, at most "
            f"{MAX_SCANNED_PX / 1e6:g} million px in all are decoded; save it as baseline JPEG",
        )
    return structure


def _check_late(body: bytes, header: ImageHeader) -> None:
    """Make the checks that `read_header` left out. Raises ImageError when the JPEG has more scans
    than `header` assumes, or is otherwise not accepted."""
    scans = _check_jpeg(body, header.width, header.height).scans
    if header.scans == 1 and scans > MAX_SEQUENTIAL_SCANS:
        raise ImageError(
            Fault.UNSUPPORTED,
            f"the JPEG has {scans} scans, a sequential one has {MAX_SEQUENTIAL_SCANS} at most; "
            "save it anew",
        )


def check_trailing(count: int) -> None:
    """Raise ImageError when `count`, the number of bytes after the end of the image, is above
    64."""
    if count > MAX_TRAILING_BYTES:
        raise ImageError(
            Fault.TRAILING,
            f"{count} bytes follow the end of the image, at most {MAX_TRAILING_BYTES} are "
            "accepted; send the image alone",
        )


def check_size(width: int, height: int) -> None:
    """Raise ImageError unless an image of this size (px) is within the service's limits: 16 to 4096
    px a side and at most 8.4 million px."""
    sides = min(width, height) >= MIN_SIDE_PX and max(width, height) <= MAX_SIDE_PX
    if not sides or width * height > MAX_PIXELS:
        raise ImageError(
            Fault.SIZE,
            f"the image is {width} x {height} px; {MIN_SIDE_PX} to {MAX_SIDE_PX} px a side and at "
            f"most {MAX_PIXELS / 1e6:.1f} million px are accepted: scale it to the model's camera",
        )


def decode_whole(body: bytes, header: ImageHeader) -> NDArray[np.uint8]:
    """Decode the image `body`, whose header `read_header` has read; returns uint8 RGB
    (header.height, header.width, 3). Raises ImageError when the image is damaged or not
    accepted."""
    if header.png_header is not None:
        image = _decode_png(body, header.png_header)
    else:
        if not header.checked:
            _check_late(body, header)
        image = _decode_jpeg(body)
    image = upright(image, header.orientation)
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
    """Crop an image (H, W, 3) to the field of view of `view`, and scale it to (view.height,
    view.width, 3).

    `fov_y_deg`: vertical field of view of the image, degrees; None: the field of view of `view`.
    Raises ImageError when the image shows less than `view`.
    """
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


def _decode_padded_jpeg(body: bytes) -> NDArray[np.uint8]:
    """Decode a JPEG to pixels (H, W, 3). A JPEG that cannot be decoded is tried again without zeros
    before its end marker, which drivers of some webcams write."""
    try:
        return _decode_jpeg(body)
    except ImageError:
        image = body.rstrip(b"\0").removesuffix(jpeg.END)
        if not image.endswith(b"\0"):
            raise
        return _decode_jpeg(image.rstrip(b"\0") + jpeg.END)


def _decode_png(body: bytes, header: png.PngHeader, *, limited: bool = True) -> NDArray[np.uint8]:
    """Decode a PNG to pixels (H, W, 3). `limited`: refuse too many chunks, and bytes after the
    image. Raises ImageError when the PNG is damaged or refused."""
    checked, end = png.critical_chunks(body, header, limited=limited)
    if limited:
        check_trailing(len(body) - end)
    image = cv2.imdecode(np.frombuffer(checked, np.uint8), cv2.IMREAD_COLOR)
    if image is None:
        raise ImageError(Fault.DAMAGED, "the PNG cannot be decoded; save it anew")
    return cv2.cvtColor(image, cv2.COLOR_BGR2RGB).astype(np.uint8, copy=False)


def _damaged_jpeg(error: ValueError) -> ImageError:
    return ImageError(
        Fault.DAMAGED, f"the JPEG cannot be decoded ({error}); give the whole file, or save it anew"
    )
