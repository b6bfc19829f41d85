"""Reads the structure of a JPEG before decoding: its end, number of scans and orientation.

Sources: ITU-T T.81, annex B; CIPA DC-008 (Exif 3.0). The decoder stops at the end marker and
ignores the following bytes; the end is determined here, so that a file appended to the image is
detected.
"""

import re
from dataclasses import dataclass

import numpy as np

from mtlnet.inference.image_decoding.errors import Fault, ImageError
from mtlnet.inference.image_decoding.orientation import EXIF_MARK, NONE, exif_orientation

START = b"\xff\xd8"
SIGNATURE = b"\xff\xd8\xff"
END = b"\xff\xd9"
SOS, EOI, APP0, APP1, APP14 = 0xDA, 0xD9, 0xE0, 0xE1, 0xEE
FRAMES = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}  # SOF0 to SOF15
DESCRIBING = FRAMES | {SOS, EOI, APP0, APP14}  # the segments that state size and colours
PROGRESSIVE_FRAMES = frozenset((0xC2, 0xC6, 0xCA, 0xCE))
# Whether FF and this byte end entropy-coded data, in which FF 00 is a byte FF, FF D0 to D7 a
# restart marker, FF FF a fill byte.
ENDS_DATA = np.ones(256, np.bool_)
ENDS_DATA[[0x00, *range(0xD0, 0xD8), 0xFF]] = False
MAX_SCANS = 100  # a progressive JPEG has about ten; the decoder reads all pixels for each scan
MAX_SEGMENTS = 1_000
WINDOW_BYTES = 1 << 18  # searched at once; other threads can run between two searches
FIRST_BYTES = 1 << 16  # searched first, which is fastest for most images
FILL = re.compile(rb"\xff+")
END_OF_DATA = re.compile(rb"\xff[^\x00\xd0-\xd7\xff]")  # FF and a byte of `ENDS_DATA`


@dataclass(frozen=True, slots=True)
class JpegStructure:
    """Structure of a JPEG: its `length` in bytes including the end marker, its number of `scans`,
    and its `orientation`, as in EXIF, 1 to 8."""

    length: int
    scans: int
    orientation: int = NONE


@dataclass(frozen=True, slots=True)
class JpegHead:
    """The content of a JPEG before its first scan. `orientation` is as in EXIF, 1 to 8.

    `description` is the JPEG reduced to the segments before the first scan that state size and
    colours. A decoder can read the size and colours from it.
    """

    is_progressive: bool
    orientation: int
    description: bytes


def read_head(body: bytes) -> JpegHead:
    """Read the content of a JPEG before its first scan, in at most 3 ms. Raises ImageError for a
    damaged JPEG or more than 1,000 segments."""
    at, frame, exif, kept = len(START), 0, None, [START]
    for _ in range(MAX_SEGMENTS):
        at, marker = _marker(body, at)
        length = 0 if marker == EOI else _length(body, at)
        if marker in DESCRIBING:
            kept.append(body[at - 2 : at + length])
        if marker in (SOS, EOI):
            orientation = NONE if exif is None else exif_orientation(exif)
            return JpegHead(frame in PROGRESSIVE_FRAMES, orientation, b"".join(kept))
        if marker in FRAMES:
            frame = frame or marker
        elif marker == APP1 and exif is None:
            exif = _exif(body, at, length)
        at += length
    raise _too_many_parts()


def read_structure(body: bytes) -> JpegStructure:
    """Read the structure of the JPEG at the start of `body`. Raises ImageError for a damaged JPEG,
    and for more than 100 scans or 1,000 segments.

    Takes at most 3 ms per MiB; other threads can run after each 256 KiB.
    """
    at, scans, exif = len(START), 0, None
    for _ in range(MAX_SEGMENTS):
        at, marker = _marker(body, at)
        if marker == EOI:
            return JpegStructure(at, scans, NONE if exif is None else exif_orientation(exif))
        length = _length(body, at)
        if marker == APP1 and exif is None and not scans:
            exif = _exif(body, at, length)
        at += length
        if marker != SOS:
            continue
        scans += 1
        if scans > MAX_SCANS:
            raise ImageError(
                Fault.UNSUPPORTED, f"the JPEG has over {MAX_SCANS} scans; save it as baseline JPEG"
            )
        at = _find_marker(body, at)
    raise _too_many_parts()


def _marker(body: bytes, at: int) -> tuple[int, int]:
    """Return the offset after the marker at offset `at`, and the marker's code."""
    if at + 2 > len(body):
        raise _ends_early(body)
    if body[at] != 0xFF:
        raise ImageError(
            Fault.DAMAGED, f"the JPEG holds no marker at byte {at}, where one must be; save it anew"
        )
    at += 1
    if body[at] == 0xFF:
        while (fill := FILL.match(body, at, at + WINDOW_BYTES)) is not None:
            at = fill.end()
        if at >= len(body):
            raise _ends_early(body)
    return at + 1, body[at]


def _find_marker(body: bytes, at: int) -> int:
    """Return the offset of the marker after the entropy-coded data at offset `at`."""
    first = END_OF_DATA.search(body, at, at + FIRST_BYTES)
    if first is not None:
        return first.start()
    # The last byte is searched again, because a marker may cross the end of the searched part.
    for start in range(at + FIRST_BYTES - 1, len(body), WINDOW_BYTES):
        # A window has one byte of the next, because a marker may cross the end of a window.
        count = min(WINDOW_BYTES + 1, len(body) - start)
        window = np.frombuffer(body, np.uint8, count, start)
        escapes = np.flatnonzero(window[:-1] == 0xFF)
        found = escapes[ENDS_DATA[window[escapes + 1]]]
        if len(found):
            return start + int(found[0])
    raise _ends_early(body)


def _length(body: bytes, at: int) -> int:
    length = int.from_bytes(body[at : at + 2], "big")
    if at + 2 > len(body) or length < 2 or at + length > len(body):
        raise _ends_early(body)
    return length


def _exif(body: bytes, at: int, length: int) -> bytes | None:
    """Return the Exif block in an APP1 segment whose length is at offset `at`; None for other
    content."""
    is_exif = body.startswith(EXIF_MARK[:-1], at + 2)  # the last byte of the mark is padding
    return body[at + 2 + len(EXIF_MARK) : at + length] if is_exif else None


def _too_many_parts() -> ImageError:
    return ImageError(Fault.UNSUPPORTED, f"the JPEG has over {MAX_SEGMENTS} parts; save it anew")


def _ends_early(body: bytes) -> ImageError:
    return ImageError(
        Fault.DAMAGED,
        f"the JPEG ends after {len(body)} bytes, before its end marker; give the whole file",
    )
