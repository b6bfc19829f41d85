"""The head of a JPEG file, and the tables that its entropy-coded part is read with.

Source: ITU-T T.81, annexes B (markers), C and F (Huffman codes).
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

DC_BITS, AC_BITS = 12, 11  # that are looked up at once
COEFFICIENTS = 320  # places of a block: 64, and all that damage could ask for beyond
NOWHERE = 80  # added to a place of a block, one of those
ENDS, LONG = 128, 255  # added to a place: the block is over; the code is to be looked up otherwise
START, DQT, DHT, SOF0, SOS = 0xD8, 0xDB, 0xC4, 0xC0, 0xDA

# fmt: off
ZIGZAG = (
    0, 1, 8, 16, 9, 2, 3, 10, 17, 24, 32, 25, 18, 11, 4, 5, 12, 19, 26, 33, 40, 48, 41, 34, 27, 20,
    13, 6, 7, 14, 21, 28, 35, 42, 49, 56, 57, 50, 43, 36, 29, 22, 15, 23, 30, 37, 44, 51, 58, 59,
    52, 45, 38, 31, 39, 46, 53, 60, 61, 54, 47, 55, 62, 63,
)
# fmt: on


class OtherKindError(ValueError):
    """A JPEG file that is not of the one kind that is read here."""


@dataclass(frozen=True)
class Head:
    """What stands before the entropy-coded bytes; `length` bytes."""

    length: int
    width: int
    height: int
    quantisers: dict[int, bytes]  # in zigzag order
    codes: dict[int, tuple[bytes, bytes]]  # of class * 16 + number: counts a length, symbols
    chosen: tuple[int, int]  # quantisers of luma and chroma


def head_length(data: bytes | memoryview) -> int:
    """Bytes before the entropy-coded ones; 0 where there are none."""
    at = 2
    while at + 4 <= len(data) and data[at] == 0xFF:
        marker, length = data[at + 1], data[at + 2] << 8 | data[at + 3]
        at += 2 + length
        if marker == SOS:
            return min(at, len(data))
    return 0


def read_head(data: bytes) -> Head:
    """Raises OtherKindError."""
    try:
        return _read_head(data)
    except (IndexError, ValueError) as error:
        raise OtherKindError(str(error)) from error


def _read_head(data: bytes) -> Head:
    at, frame = 2, b""
    quantisers: dict[int, bytes] = {}
    codes: dict[int, tuple[bytes, bytes]] = {}
    _require(data[:2] == bytes((0xFF, START)), "it does not start as a JPEG file")
    while True:
        _require(data[at] == 0xFF, "there is no marker")
        marker, length = data[at + 1], int.from_bytes(data[at + 2 : at + 4], "big")
        segment = data[at + 4 : at + 2 + length]
        at += 2 + length
        if marker == DQT:
            _read_quantisers(segment, quantisers)
        elif marker == DHT:
            _read_codes(segment, codes)
        elif marker == SOF0:
            frame = segment
        elif marker == SOS:
            break
        else:
            _require(0xE0 <= marker <= 0xEF or marker == 0xFE, f"marker {marker:#x}")
    _require(segment == bytes((3, 1, 0, 2, 0x11, 3, 0x11, 0, 63, 0)), "more than one scan")
    _require(len(frame) == 15 and frame[0] == 8 and frame[5] == 3, "it is not 8 bits of 3 colours")
    sampling = frame[6::3], frame[7::3], frame[8] != frame[11] == frame[14]
    _require(sampling == (b"\1\2\3", b"\x22\x11\x11", True), "it is not 4:2:0")
    _require({0, 1, 16, 17} <= codes.keys(), "a table is missing")
    _require({frame[8], frame[11]} <= quantisers.keys(), "a table is missing")
    height, width = (int.from_bytes(frame[i : i + 2], "big") for i in (1, 3))
    return Head(at, width, height, quantisers, codes, (frame[8], frame[11]))


def _read_quantisers(segment: bytes, into: dict[int, bytes]) -> None:
    _require(len(segment) % 65 == 0, "a quantiser is not of 8 bits")
    for at in range(0, len(segment), 65):
        into[segment[at]] = segment[at + 1 : at + 65]


def _read_codes(segment: bytes, into: dict[int, tuple[bytes, bytes]]) -> None:
    at = 0
    while at < len(segment):
        counts = segment[at + 1 : at + 17]
        end = at + 17 + sum(counts)
        # Each length's codes follow the shorter ones': together they must fit into 16 bits.
        room = sum(count << (16 - length) for length, count in enumerate(counts, 1))
        _require(len(counts) == 16 and end <= len(segment) and room <= 1 << 16, "a bad table")
        into[segment[at]] = counts, segment[at + 17 : end]
        at = end


def _require(holds: bool, what: str) -> None:
    if not holds:
        raise OtherKindError(what)


def code_table(counts: bytes, symbols: bytes) -> NDArray[np.uint16]:
    """(65536,) by the next 16 bits: length of the code * 256 + symbol; 0 where none is."""
    table = np.zeros(1 << 16, np.uint16)
    at, number = 0, 0
    for length, count in enumerate(counts, 1):
        for _ in range(count):
            size = 1 << (16 - length)
            table[at : at + size] = length << 8 | symbols[number]
            at += size
            number += 1
    return table


def _value(bits: int, size: int) -> int:
    """The number that `size` bits stand for (T.81, table F.1)."""
    return bits if not size or bits >> (size - 1) else bits - (1 << size) + 1


def dc_table(codes: NDArray[np.uint16]) -> NDArray[np.int64]:
    """By the next `DC_BITS` bits: value << 16 | bits used; 0 where they do not suffice."""
    table = np.zeros(1 << DC_BITS, np.int64)
    for bits in range(len(table)):
        length, size = divmod(int(codes[bits << (16 - DC_BITS)]), 256)
        rest = DC_BITS - length - size
        if length and rest >= 0:
            table[bits] = _value((bits >> rest) & ((1 << size) - 1), size) << 16 | (length + size)
    return table


def ac_table(codes: NDArray[np.uint16]) -> NDArray[np.int64]:
    """By the next `AC_BITS` bits: one coefficient, or two.

    Bits 0 to 7: bits used; from 8, 16 and 24, 8 bits each: what to add to the place of the last
    coefficient for that of the first, of the second (the first again where there is one) and of
    the last, `ENDS` more when the block ends; 32 to 47 and 48 to 63: first and second value.
    """
    table = np.zeros(1 << AC_BITS, np.int64)
    for bits in range(len(table)):
        first = _symbol(codes, bits, AC_BITS)
        if first is None:
            table[bits] = _entry(0, NOWHERE, NOWHERE, LONG, 0, 0)
            continue
        used, step, value = first
        second = _symbol(codes, (bits << used) & ((1 << AC_BITS) - 1), AC_BITS - used)
        if not step:
            table[bits] = _entry(used, NOWHERE, NOWHERE, ENDS, 0, 0)
        elif second is None:
            table[bits] = _entry(used, step, step, step, value, value)
        elif not second[1]:
            both = used + second[0]
            table[bits] = _entry(both, step, step, step + ENDS, value, value)
        else:
            both, last = used + second[0], step + second[1]
            table[bits] = _entry(both, step, last, last, value, second[2])
    return table


def _symbol(codes: NDArray[np.uint16], bits: int, known: int) -> tuple[int, int, int] | None:
    """Bits used, how much further its coefficient is (0: the block ends), value; None where the
    first `known` of `AC_BITS` bits do not suffice."""
    length, symbol = divmod(int(codes[bits << (16 - AC_BITS)]), 256)
    size = symbol & 15
    if not length or length + size > known:
        return None
    step = 0 if symbol == 0 else (symbol >> 4) + 1
    rest = AC_BITS - length - size
    return length + size, step, _value((bits >> rest) & ((1 << size) - 1), size)


def _entry(used: int, first: int, second: int, last: int, v: int, w: int) -> int:
    return used | first << 8 | second << 16 | last << 24 | (v & 0xFFFF) << 32 | w << 48


def places(lanes: int) -> NDArray[np.uint16]:
    """(COEFFICIENTS,) place in memory by place in the file; the last one's beyond 64."""
    beyond = COEFFICIENTS - len(ZIGZAG)
    return np.array(ZIGZAG + (ZIGZAG[-1],) * beyond, np.uint16) * np.uint16(lanes)


def factors(quantiser: bytes, lanes: int) -> NDArray[np.int16]:
    """(64 * lanes,) what coefficients are multiplied with, as they lie in memory."""
    found = np.zeros(len(ZIGZAG), np.int16)
    found[list(ZIGZAG)] = list(quantiser)
    return found.repeat(lanes)
