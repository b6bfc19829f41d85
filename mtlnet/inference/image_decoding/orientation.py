"""Reads the orientation of an image from the tag Orientation of EXIF and TIFF, and corrects it.

Sources: CIPA DC-008 (Exif 3.0), TIFF 6.0, BigTIFF. As in browsers, a damaged or invalid orientation
counts as upright, only the first directory is read (the next is the thumbnail's), and XMP is
ignored.
"""

import struct
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

ORIENTATION = 0x0112
SHORT, LONG = 3, 4
NONE = 1
EXIF_MARK = b"Exif\0\0"
MAX_ENTRIES = 1_000  # entries read from a directory; they are sorted by tag
# By version (TIFF, BigTIFF): formats of the number of entries and of an entry (tag, type, count,
# value); format and position of the first directory's offset.
ENTRIES = {42: ("H", "HHI4s"), 43: ("Q", "HHQ8s")}
OFFSETS = {42: ("I", 4), 43: ("Q", 8)}


def swaps_sides(orientation: int) -> bool:
    """Return whether an image of this orientation (1 to 8) must be turned by a quarter turn to be
    upright, so that its stored height becomes its width."""
    return orientation >= 5


def exif_orientation(exif: bytes) -> int:
    """Return the orientation, 1 to 8, in an Exif block with or without its mark `Exif`; 1 (upright)
    if the block has none."""
    kind, value = read_tags(exif.removeprefix(EXIF_MARK)).get(ORIENTATION, (SHORT, NONE))
    return value if kind == SHORT and 1 <= value <= 8 else NONE


def read_tags(block: bytes) -> dict[int, tuple[int, int]]:
    """Read the first directory of a TIFF block; returns a dict from tag to (type, value).

    The value is -1 if it is not a single SHORT or LONG. Of a damaged block, the dict has the tags
    that can be read.
    """
    order: Literal["little", "big"] = "little" if block.startswith(b"II") else "big"
    version = int.from_bytes(block[2:4], order)
    if not block.startswith((b"II", b"MM")) or version not in ENTRIES:
        return {}
    sign = "<" if order == "little" else ">"
    count, entry = (sign + part for part in ENTRIES[version])
    offset, at = OFFSETS[version]
    try:
        (start,) = struct.unpack_from(sign + offset, block, at)
        (number,) = struct.unpack_from(count, block, start)
    except (struct.error, OverflowError):
        return {}
    start += struct.calcsize(count)
    number = min(number, MAX_ENTRIES, (len(block) - start) // struct.calcsize(entry))
    entries = block[start : start + number * struct.calcsize(entry)]
    tags: dict[int, tuple[int, int]] = {}
    for tag, kind, values, value in struct.iter_unpack(entry, entries):
        width = {SHORT: 2, LONG: 4}.get(kind) if values == 1 else None
        number = -1 if width is None else int.from_bytes(value[:width], order)
        tags.setdefault(tag, (kind, number))
    return tags


def upright(image: NDArray[np.uint8], orientation: int) -> NDArray[np.uint8]:
    """Rotate and mirror an image (H, W, C) to be upright; returns (H, W, C), or (W, H, C) where the
    sides are swapped.

    `orientation` names the sides of the upright image where the stored first row and first column
    are: 1 top left, 2 top right, 3 bottom right, 4 bottom left, 5 left top, 6 right top, 7 right
    bottom, 8 left bottom.
    """
    if orientation == NONE:
        return image
    if orientation in (5, 7):
        image = cv2.transpose(image).astype(np.uint8, copy=False)
    turn = {2: 1, 3: -1, 4: 0, 7: -1}.get(orientation)
    if turn is not None:
        return cv2.flip(image, turn).astype(np.uint8, copy=False)
    code = {6: cv2.ROTATE_90_CLOCKWISE, 8: cv2.ROTATE_90_COUNTERCLOCKWISE}.get(orientation)
    return image if code is None else cv2.rotate(image, code).astype(np.uint8, copy=False)
