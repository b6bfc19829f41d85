"""The structure of a JPEG, checked before decoding: its end and its number of scans.

Source: ITU-T T.81, annex B. The decoder stops at the end marker and ignores what follows; here the
end is found, so that a file appended to the image is detected.
"""

import re

from mtlnet.inference.image_decoding.errors import Fault, ImageError

START = b"\xff\xd8"
SIGNATURE = b"\xff\xd8\xff"
SOS, EOI = 0xDA, 0xD9
# In entropy-coded data FF 00 is a byte FF, FF D0 to D7 a restart marker, FF FF a fill byte.
MARKER = re.compile(rb"\xff[^\x00\xd0-\xd7\xff]")
MAX_SCANS = 100  # a progressive JPEG has about ten; each costs a pass over all pixels
MAX_SEGMENTS = 1_000


def jpeg_length(body: bytes) -> int:
    """Length of the JPEG at the start of `body`, with its end marker. Raises ImageError."""
    at, scans = len(START), 0
    for _ in range(MAX_SEGMENTS):
        at, marker = _marker(body, at)
        if marker == EOI:
            return at
        at += _length(body, at)
        if marker != SOS:
            continue
        scans += 1
        if scans > MAX_SCANS:
            raise ImageError(
                Fault.UNSUPPORTED, f"the JPEG has over {MAX_SCANS} scans; save it as baseline JPEG"
            )
        found = MARKER.search(body, at)
        if found is None:
            raise _ends_early(body)
        at = found.start()
    raise ImageError(Fault.UNSUPPORTED, f"the JPEG has over {MAX_SEGMENTS} parts; save it anew")


def _marker(body: bytes, at: int) -> tuple[int, int]:
    """(Offset after the marker at offset `at`, the marker's code)."""
    if at + 2 > len(body):
        raise _ends_early(body)
    if body[at] != 0xFF:
        raise ImageError(
            Fault.DAMAGED, f"the JPEG holds no marker at byte {at}, where one must be; save it anew"
        )
    while body[at + 1] == 0xFF:
        at += 1
        if at + 2 > len(body):
            raise _ends_early(body)
    return at + 2, body[at + 1]


def _length(body: bytes, at: int) -> int:
    length = int.from_bytes(body[at : at + 2], "big")
    if at + 2 > len(body) or length < 2 or at + length > len(body):
        raise _ends_early(body)
    return length


def _ends_early(body: bytes) -> ImageError:
    return ImageError(
        Fault.DAMAGED,
        f"the JPEG ends after {len(body)} bytes, before its end marker; give the whole file",
    )
