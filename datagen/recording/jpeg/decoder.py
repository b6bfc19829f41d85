"""A decoder for pictures of one head; see the package."""

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from datagen.recording.jpeg import tables
from datagen.recording.jpeg.entropy import BLOCKS, SPARE
from datagen.recording.jpeg.lot import Lot, decoded_lot
from datagen.recording.jpeg.tables import Head, OtherKindError
from datagen.recording.jpeg.transform import LANES, STEP

GROUP = 64 * LANES  # coefficients
AROUND = 64  # bytes beyond a row of samples that may be read, and written at its sides


class Decoder:
    """Decodes pictures that start with the same `head`; not for two threads at a time.

    Raises OtherKindError for a head of another kind.
    """

    def __init__(self, head: bytes) -> None:
        self.head = _read(head)
        width, height = self.head.width, self.head.height
        if width < STEP or width % 2 or not height:
            raise OtherKindError(f"{width}x{height} px are not read here")
        self._bytes = head
        self._tables, self._codes, self._factors = _tables(head)
        self._places = tables.places(LANES)
        across = (width + 15) // 16  # units
        self._units, starts = _layout(across)
        luma, chroma = _padded(2 * across) * 8, _padded(across) * 8 + AROUND
        down = (height + 15) // 16
        sizes = np.array([16 * down * luma, 8 * down * chroma, 8 * down * chroma])
        begins = AROUND + np.concatenate(([0], np.cumsum(sizes)[:-1]))
        strides = (luma, chroma, chroma)
        self._planes = np.array(list(zip(begins.tolist(), strides, strict=True)), np.int64)
        self._groups = np.array(
            [
                (begins[p] + y * strides[p] + x, (16, 8, 8)[p] * strides[p], strides[p], by)
                for p, y, x in starts
                for by in (GROUP if p else 0,)
            ],
            np.int64,
        )
        self._samples = np.zeros(int(sizes.sum()) + 2 * AROUND, np.uint8)
        self._coefficients = np.zeros(len(starts) * GROUP, np.int16)
        self._coded = np.zeros(1 << 16, np.uint8)

    def decode(self, data: bytes | memoryview, out: NDArray[np.uint8]) -> bool:
        """`data` to `out` (H, W, 3) RGB without gaps; False for what is damaged or of another kind.

        `data` starts with this decoder's head. Then `out` may hold anything.
        """
        done = np.zeros(1, np.bool_)
        self.decode_lot(Lot.of(self._bytes, [0], [data]), out[np.newaxis], done)
        return bool(done[0])

    def decode_lot(self, lot: Lot, out: NDArray[np.uint8], done: NDArray[np.bool_]) -> None:
        """Pictures of `lot` that no other thread takes, to its rows of `out` (B, H, W, 3).

        `done` (B,) becomes true for those that were decoded; other rows may hold anything.
        """
        head = self.head
        if out.shape[1:] != (head.height, head.width, 3) or not out.flags.c_contiguous:
            return
        longest = int(lot.lengths.max(initial=0)) + SPARE
        if len(self._coded) < longest:
            self._coded = np.zeros(2 * longest, np.uint8)
        decoded_lot(
            lot.rows, lot.addresses, lot.lengths, lot.taken, head.length, head.width, head.height,
            self._tables, self._codes, self._places, self._factors, self._units, self._groups,
            self._planes, self._coefficients, self._samples, self._coded,
            out.reshape(len(out), -1), done,
        )  # fmt: skip


@lru_cache(maxsize=8)
def _read(head: bytes) -> Head:
    return tables.read_head(head)


@lru_cache(maxsize=8)
def _tables(head: bytes) -> tuple[NDArray[np.int64], NDArray[np.uint16], NDArray[np.int16]]:
    """DC and AC, luma's before chroma's; codes of DC and AC likewise; factors likewise."""
    found = _read(head)
    codes = [tables.code_table(*found.codes[number]) for number in (0, 1, 16, 17)]
    parts = [tables.dc_table(codes[0]), tables.dc_table(codes[1])]
    parts += [tables.ac_table(codes[2]), tables.ac_table(codes[3])]
    factors = [tables.factors(found.quantisers[number], LANES) for number in found.chosen]
    return np.concatenate(parts), np.concatenate(codes), np.concatenate(factors)


def _padded(blocks: int) -> int:
    return -(-blocks // LANES) * LANES


def _layout(across: int) -> tuple[NDArray[np.int64], list[tuple[int, int, int]]]:
    """Where the blocks of `across` units lie among the coefficients, and where the groups of them
    go: plane, row and column of samples. A group is of neighbours in one row of blocks."""
    rows = [(0, 0, 2 * across), (0, 8, 2 * across), (1, 0, across), (2, 0, across)]
    starts: list[tuple[int, int, int]] = []
    firsts = []
    for plane, y, blocks in rows:
        firsts.append(len(starts))
        starts += [(plane, y, 8 * x) for x in range(0, blocks, LANES)]
    units = np.zeros(across * BLOCKS, np.int64)
    for number in range(len(units)):
        unit, block = divmod(number, BLOCKS)
        row, place = (block >> 1, 2 * unit + (block & 1)) if block < 4 else (block - 2, unit)
        units[number] = (firsts[row] + place // LANES) * GROUP + place % LANES
    return units, starts
