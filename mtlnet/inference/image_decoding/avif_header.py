"""Reads size and orientation of an AVIF image from the properties of its primary item.

Sources: ISO/IEC 14496-12 (boxes), 23008-12 (HEIF), 23000-22 (MIAF: `irot` rotates, then `imir`
mirrors; an orientation in EXIF is ignored).
"""

from collections.abc import Iterator

from mtlnet.inference.image_decoding.errors import Fault, ImageError

# Orientation (as in EXIF) by mirroring (none, vertical, horizontal) after an anticlockwise rotation
# by 0, 90, 180 or 270 degrees.
ORIENTATIONS = {None: (1, 8, 3, 6), 0: (4, 5, 2, 7), 1: (2, 7, 4, 5)}
MAX_BOXES = 10_000


def read_header(body: bytes) -> tuple[int, int, int]:
    """Read an AVIF file's header; returns width and height in px as stored, and the orientation as
    in EXIF, 1 to 8. Raises ImageError for an incomplete header."""
    try:
        return _primary(memoryview(body))
    except (IndexError, KeyError):
        raise ImageError(
            Fault.DAMAGED, "the AVIF's header is incomplete; give the whole file"
        ) from None


def _primary(body: memoryview) -> tuple[int, int, int]:
    meta = dict(_boxes(dict(_boxes(body))[b"meta"][4:]))
    item = _number(meta[b"pitm"], 4, 4 if meta[b"pitm"][0] else 2)
    properties = dict(_boxes(meta[b"iprp"]))
    known = list(_boxes(properties[b"ipco"]))
    own = dict(known[number - 1] for number in _associations(properties[b"ipma"], item) if number)
    turns = own[b"irot"][0] & 3 if b"irot" in own else 0
    mirror = own[b"imir"][0] & 1 if b"imir" in own else None
    return _number(own[b"ispe"], 4, 4), _number(own[b"ispe"], 8, 4), ORIENTATIONS[mirror][turns]


def _boxes(data: memoryview) -> Iterator[tuple[bytes, memoryview]]:
    """Yield type and content of each box in `data`."""
    at = 0
    for _ in range(MAX_BOXES):
        if at + 8 > len(data):
            return
        size, kind, head = _number(data, at, 4), bytes(data[at + 4 : at + 8]), 8
        if size == 1:
            size, head = _number(data, at + 8, 8), 16
        end = at + size if size else len(data)
        if end < at + head:
            return
        yield kind, data[at + head : end]
        at = end


def _associations(ipma: memoryview, item: int) -> list[int]:
    """Return the numbers, from 1, of the properties of an item in an `ipma` box; 0 stands for no
    property."""
    id_bytes, step = 4 if ipma[0] else 2, 2 if ipma[3] & 1 else 1
    at = 8
    for _ in range(min(_number(ipma, 4, 4), MAX_BOXES)):
        found, count = _number(ipma, at, id_bytes), ipma[at + id_bytes]
        at += id_bytes + 1
        if found == item:
            numbers = [_number(ipma, at + i * step, step) for i in range(count)]
            return [number & (0x7F if step == 1 else 0x7FFF) for number in numbers]
        at += count * step
    return []


def _number(data: memoryview, at: int, size: int) -> int:
    if at + size > len(data):
        raise IndexError
    return int.from_bytes(data[at : at + size], "big")
