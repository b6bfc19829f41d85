"""Checks the structure of a PNG before decoding: header, checksums, amount of pixel data.

Source: PNG specification, third edition (W3C). Decoders differ in the damage that they accept and
in their use of ancillary chunks (orientation, animation, colour profiles). Therefore
`critical_chunks` checks the critical chunks and removes ancillary chunks; `find_exif` finds the
orientation.
"""

import struct
import zlib
from dataclasses import dataclass

from mtlnet.inference.image_decoding.errors import Fault, ImageError

SIGNATURE = b"\x89PNG\r\n\x1a\n"
# Limit of the number of chunks: FREE_CHUNKS, and one for each BYTES_A_CHUNK of the file. Encoders
# write chunks of at least 8 KiB. The check of a chunk takes at least a microsecond.
FREE_CHUNKS, BYTES_A_CHUNK = 256, 1024
CHANNELS = {0: 1, 2: 3, 3: 1, 4: 2, 6: 4}  # by colour type
DEPTHS = {0: (1, 2, 4, 8, 16), 2: (8, 16), 3: (1, 2, 4, 8), 4: (8, 16), 6: (8, 16)}
# First column, first row, column step, row step of the seven Adam7 passes.
PASSES = (
    (0, 0, 8, 8),
    (4, 0, 8, 8),
    (0, 4, 4, 8),
    (2, 0, 4, 4),
    (0, 2, 2, 4),
    (1, 0, 2, 2),
    (0, 1, 1, 2),
)
FILTERS = 5


@dataclass(frozen=True, slots=True)
class PngHeader:
    """Header of a PNG (IHDR): size in px, bits per pixel, and whether it is interlaced.

    `file_bytes`: size of the whole file in bytes.
    """

    width: int
    height: int
    pixel_bits: int
    interlaced: bool
    file_bytes: int

    def passes(self) -> list[tuple[int, int]]:
        """Return, for each interlacing pass, the number of rows and the bytes per row without the
        filter byte. A PNG that is not interlaced has one pass."""
        steps = PASSES if self.interlaced else ((0, 0, 1, 1),)
        sizes = []
        for column, row, across, down in steps:
            columns = -(-(self.width - column) // across)
            rows = -(-(self.height - row) // down)
            if columns > 0 and rows > 0:
                sizes.append((rows, -(-columns * self.pixel_bits // 8)))
        return sizes


def read_header(body: bytes) -> PngHeader:
    """Read the header of a PNG that starts with `SIGNATURE`. Raises ImageError for a header that
    the PNG specification does not allow."""
    start = len(SIGNATURE)
    if len(body) < start + 25 or body[start : start + 8] != b"\x00\x00\x00\x0dIHDR":
        raise ImageError(Fault.DAMAGED, "the PNG does not begin with IHDR; save it anew")
    width, height, depth, colour, compression, filtering, interlace = struct.unpack_from(
        ">IIBBBBB", body, start + 8
    )
    if depth not in DEPTHS.get(colour, ()) or compression or filtering or interlace > 1:
        raise ImageError(
            Fault.UNSUPPORTED,
            f"the PNG's header asks for colour type {colour} with {depth} bits, compression "
            f"{compression}, filter {filtering}, interlace {interlace}, which PNG does not define; "
            "save it anew",
        )
    pixel_bits = depth * CHANNELS[colour]
    return PngHeader(width, height, pixel_bits, bool(interlace), len(body))


def find_exif(body: bytes, *, limited: bool = True) -> bytes:
    """Return the content of the first `eXIf` chunk; empty if there is none. Its checksum is not
    verified.

    `limited`: search only as many chunks as `critical_chunks` allows.
    """
    at = len(SIGNATURE)
    for _ in range(_most_chunks(body, limited)):
        kind = body[at + 4 : at + 8]
        end = at + 12 + int.from_bytes(body[at : at + 4], "big")
        if kind == b"eXIf":
            return body[at + 8 : end - 4]
        if kind == b"IEND" or end > len(body):
            break
        at = end
    return b""


def _most_chunks(body: bytes, limited: bool) -> int:
    return FREE_CHUNKS + len(body) // (BYTES_A_CHUNK if limited else 1)


def critical_chunks(body: bytes, header: PngHeader, *, limited: bool = True) -> tuple[bytes, int]:
    """Check a PNG; returns the PNG reduced to its critical chunks (header, palette, pixels, end),
    and the offset of its end in `body`.

    `limited`: allow at most 256 chunks plus one for each KiB of the file. Raises ImageError for a
    damaged or refused PNG.
    """
    kept: list[bytes | memoryview] = [SIGNATURE]
    pixels: list[memoryview] = []
    view = memoryview(body)
    at = len(SIGNATURE)
    most = _most_chunks(body, limited)
    for _ in range(most):
        end, kind = _check_chunk(view, at)
        if kind in (b"IHDR", b"PLTE", b"IDAT", b"IEND"):
            kept.append(view[at:end])
            if kind == b"IDAT":
                pixels.append(view[at + 8 : end - 4])
        elif not kind[0] & 0x20:  # bit 5 clear: a critical chunk, which a decoder must not skip
            raise ImageError(
                Fault.UNSUPPORTED, f"the PNG needs the unknown chunk {kind!r}; save it as plain PNG"
            )
        if kind == b"IEND":
            break
        at = end
    else:
        raise ImageError(Fault.UNSUPPORTED, f"the PNG has over {most} chunks; save it anew")
    _check_pixels(b"".join(pixels), header)
    return b"".join(kept), end


def _check_chunk(view: memoryview, at: int) -> tuple[int, bytes]:
    """Return end offset and type of the chunk at offset `at`. Raises ImageError for a truncated
    chunk or a wrong checksum."""
    if at + 12 > len(view):
        raise ImageError(
            Fault.DAMAGED,
            f"the PNG ends after {len(view)} bytes, before its end chunk; give the whole file",
        )
    length = int.from_bytes(view[at : at + 4], "big")
    end = at + 12 + length
    if end > len(view):
        raise ImageError(
            Fault.DAMAGED,
            f"the PNG has {len(view)} bytes, a chunk of it reaches to {end}; give the whole file",
        )
    if zlib.crc32(view[at + 4 : end - 4]) != int.from_bytes(view[end - 4 : end], "big"):
        raise ImageError(Fault.DAMAGED, f"the PNG's checksum at byte {at} is wrong; save it anew")
    return end, bytes(view[at + 4 : at + 8])


def _check_pixels(compressed: bytes, header: PngHeader) -> None:
    expected = sum(rows * (1 + row_bytes) for rows, row_bytes in header.passes())
    inflater = zlib.decompressobj()
    try:
        # At most one byte more than the header declares, so that the size limits bound the memory.
        raw = inflater.decompress(compressed, expected + 1)
    except zlib.error as error:
        raise ImageError(
            Fault.DAMAGED, f"the PNG's pixels do not inflate ({error}); save it anew"
        ) from error
    if len(raw) != expected or not inflater.eof:
        seen = f"more than {expected}" if len(raw) > expected else f"{len(raw)} of {expected}"
        raise ImageError(Fault.DAMAGED, f"the PNG holds {seen} bytes of pixels; save it anew")
    at = 0
    for rows, row_bytes in header.passes():
        size = rows * (1 + row_bytes)
        if max(raw[at : at + size : 1 + row_bytes]) >= FILTERS:
            raise ImageError(Fault.DAMAGED, "the PNG has a row of an unknown filter; save it anew")
        at += size
