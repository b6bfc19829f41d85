"""Decodes image files of this machine other than JPEG and PNG, if OpenCV reads their kind. For a
kind that is not read, the error message names the kind.

The kind of a file is determined by its first bytes, not its name. Its size is read from its header
before OpenCV decodes it, because OpenCV allocates memory for the stated size. If a file has several
pictures, the first is read.
"""

import re
import struct
from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from mtlnet.inference.image_decoding import avif_header
from mtlnet.inference.image_decoding.errors import Fault, ImageError
from mtlnet.inference.image_decoding.orientation import (
    NONE,
    exif_orientation,
    read_tags,
    upright,
)

SUFFIXES = (
    *(".jpg", ".jpeg", ".jpe", ".jfif", ".mpo", ".png", ".apng", ".webp", ".bmp", ".dib"),
    *(".tif", ".tiff", ".avif", ".gif", ".pnm", ".ppm", ".pgm", ".pbm"),
)
"""Suffixes of files that are read, in lower case."""
IMAGE_WIDTH, IMAGE_HEIGHT = 256, 257  # TIFF tags
NEW_SUBFILE_TYPE, DNG_VERSION = 254, 50706
REDUCED = 1  # bit of NEW_SUBFILE_TYPE: a smaller copy of another image in the file
FIRST_BYTES = 1024  # number of bytes that determine the kind of a file

Header = tuple[int, int, int]
"""Width and height in px of the picture that OpenCV decodes, and its orientation, 1 to 8, which
`decode` corrects."""


@dataclass(frozen=True, slots=True)
class Kind:
    """A kind of image file. `signature` matches the first bytes of a file; `suffix` is the end of a
    file's name by which OpenCV identifies the kind, such as ".webp"."""

    name: str
    suffix: str
    signature: re.Pattern[bytes]
    read_header: Callable[[bytes], Header]
    """Reads the header. Raises ImageError, struct.error or IndexError for a damaged header."""


def find_kind(body: bytes) -> Kind | None:
    """Return the kind of image file that `body` holds; None for JPEG, PNG and all kinds that are
    not read."""
    return next((kind for kind in KINDS if kind.signature.match(body[:FIRST_BYTES])), None)


def describe(body: bytes) -> str:
    """Return a text for an error message about bytes that are not a JPEG or PNG. It names their
    kind and gives advice."""
    if (kind := find_kind(body)) is not None:
        return f"a {kind.name} image; {SAVE}"
    first = body[:FIRST_BYTES]
    for what, advice, signature in UNREAD:
        if signature.match(first):
            return f"{what}; {advice}"
    return f"{len(body)} bytes that begin with {body[:8]!r}" if body else "nothing at all"


def read_header(body: bytes, kind: Kind) -> Header:
    """Read the header of a file of this kind; returns width and height (px) and orientation, 1 to
    8. Raises ImageError for a damaged or unsupported file."""
    try:
        return kind.read_header(body)
    except (struct.error, IndexError):
        raise ImageError(
            Fault.DAMAGED, f"the {kind.name}'s header is incomplete; give the whole file"
        ) from None


def decode(body: bytes, kind: Kind, orientation: int) -> NDArray[np.uint8]:
    """Decode the first picture of a file; returns upright uint8 RGB (H, W, 3). `orientation`: as
    returned by `read_header`. Raises ImageError when OpenCV cannot decode the file."""
    flags = cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION
    try:
        image = cv2.imdecode(np.frombuffer(body, np.uint8), flags)
    except cv2.error:
        image = None
    if image is None:
        if not cv2.haveImageWriter(kind.suffix):
            reason = f"this build of OpenCV ({cv2.__version__}) has no decoder for {kind.name}"
            raise ImageError(Fault.UNSUPPORTED, f"{reason}; {SAVE}")
        raise ImageError(
            Fault.DAMAGED,
            f"the {kind.name} cannot be decoded: it is damaged, incomplete or in a coding that "
            f"OpenCV does not read; give the whole file, or {SAVE}",
        )
    return upright(cv2.cvtColor(image, cv2.COLOR_BGR2RGB).astype(np.uint8, copy=False), orientation)


def _read_webp(body: bytes) -> Header:
    """Read the header of a WebP file (RFC 9649), whose first chunk is a lossy or lossless picture,
    or describes the following chunks."""
    kind, data = body[12:16], body[20:30]
    if kind == b"VP8 ":
        width, height = struct.unpack_from("<HH", data, 6)
        return width & 0x3FFF, height & 0x3FFF, NONE
    if kind == b"VP8L":
        (bits,) = struct.unpack_from("<I", data, 1)
        return (bits & 0x3FFF) + 1, (bits >> 14 & 0x3FFF) + 1, NONE
    sizes = [int.from_bytes(data[at : at + 3], "little") + 1 for at in (4, 7)]
    return sizes[0], sizes[1], exif_orientation(_riff_chunk(body, b"EXIF"))


def _riff_chunk(body: bytes, wanted: bytes) -> bytes:
    """Return the content of the first chunk of type `wanted` in a RIFF file; empty if there is
    none."""
    at = 12
    while at + 8 <= len(body):
        size = int.from_bytes(body[at + 4 : at + 8], "little")
        if body[at : at + 4] == wanted:
            return body[at + 8 : at + 8 + size]
        at += 8 + size + size % 2
    return b""


def _read_bmp(body: bytes) -> Header:
    if body[14] == 12:  # header of OS/2
        return *struct.unpack_from("<HH", body, 18), NONE
    width, height = struct.unpack_from("<ii", body, 18)
    return abs(width), abs(height), NONE  # a negative height: rows are stored from the top


def _read_tiff(body: bytes) -> Header:
    """Read the header of a TIFF file. The orientation is always 1, because OpenCV itself rotates a
    TIFF upright, whatever the flags."""
    tags = read_tags(body)
    if DNG_VERSION in tags or tags.get(NEW_SUBFILE_TYPE, (0, 0))[1] & REDUCED:
        raise ImageError(
            Fault.UNSUPPORTED,
            f"the file is a camera's raw file (such as DNG, NEF, ARW), of which OpenCV reads the "
            f"small preview only; {SAVE}",
        )
    width, height = (tags.get(tag, (0, -1))[1] for tag in (IMAGE_WIDTH, IMAGE_HEIGHT))
    if min(width, height) < 0:
        raise IndexError
    return width, height, NONE


def _read_gif(body: bytes) -> Header:
    return *struct.unpack_from("<HH", body, 6), NONE


def _read_pnm(body: bytes) -> Header:
    found = PNM_SIZE.match(body[:FIRST_BYTES])
    if found is None:
        raise IndexError
    return int(found[1]), int(found[2]), NONE


def _kind(name: str, suffix: str, signature: bytes, header: Callable[[bytes], Header]) -> Kind:
    return Kind(name, suffix, re.compile(signature, re.DOTALL), header)


PNM_SIZE = re.compile(rb"P[1-6]" + 2 * rb"(?:\s|#[^\n]*\n)+(\d{1,9})")
KINDS = (
    _kind("WebP", ".webp", rb"RIFF....WEBPVP8[ LX]", _read_webp),
    _kind("BMP", ".bmp", rb"BM.{12}[\x0c-\x7c]\0\0\0", _read_bmp),
    _kind("TIFF", ".tif", rb"II[*+]\0|MM\0[*+]", _read_tiff),
    _kind("AVIF", ".avif", rb"....ftyp(?:.{4}){0,16}?avi[fs]", avif_header.read_header),
    _kind("GIF", ".gif", rb"GIF8[79]a", _read_gif),
    _kind("PNM", ".pnm", rb"P[1-6]\s", _read_pnm),
)
READ = ", ".join(("JPEG", "PNG", *(kind.name for kind in KINDS)))
SAVE = "save it as JPEG or PNG"
FILM = "give a film a film's suffix (.mp4, .mov, .avi, .mkv, .webm)"
UNREAD = tuple(
    (what, advice, re.compile(signature, re.DOTALL | re.IGNORECASE))
    for what, advice, signature in (
        ("a HEIC (HEIF) photo", SAVE, rb"....ftyp(?:.{4}){0,8}?(?:hei[cxms]|hev[cxms]|mif1|msf1)"),
        ("a camera's raw file", SAVE, rb"....ftypcrx |FUJIFILMCCD-RAW|IIU\0|IIRO|IIRS|MMOR"),
        ("a film", FILM, rb"....(?:ftyp|moov|mdat|wide)|\x1a\x45\xdf\xa3|RIFF....AVI |FLV"),
        ("a JPEG XL", SAVE, rb"\xff\x0a|\0\0\0\x0cJXL "),
        ("a JPEG 2000", SAVE, rb"\xff\x4f\xff\x51|\0\0\0\x0cjP  "),
        ("a picture with floating-point pixels (HDR, EXR, PFM)", SAVE, rb"#\?|v/1\x01|P[Ff]\s"),
        ("a Photoshop file", SAVE, rb"8BPS"),
        ("a PDF", SAVE, rb"%PDF"),
        ("an HTML page", "download the image itself", rb"\s*(?:<!DOCTYPE html|<html|<head|<body)"),
        ("an SVG drawing", SAVE, rb"\s*<.*<svg|\s*<svg"),
        ("an XML file", "give an image", rb"\s*<\?xml"),
        ("an archive (ZIP, gzip, 7z)", "unpack it", rb"PK\x03\x04|\x1f\x8b|7z\xbc\xaf\x27\x1c"),
        (
            "a file compressed with Zstandard",
            "if it is part of a ROS 2 bag, give the folder of the bag; otherwise unpack it",
            rb"\x28\xb5\x2f\xfd",
        ),
        ("a ROS 1 bag", "convert it to a ROS 2 bag with `rosbags-convert`", rb"#ROSBAG"),
        ("a recorded round (MCAP)", "give it the suffix .mcap", rb"\x89MCAP0"),
        ("a NumPy array", SAVE, rb"\x93NUMPY"),
        (
            "a pointer of Git LFS in place of the file",
            "fetch the file with `git lfs pull`",
            rb"version https://git-lfs",
        ),
        ("zeros only, as of a broken copy", "copy it anew", rb"\0+\Z"),
    )
)
