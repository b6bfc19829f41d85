"""Pictures of one head that several threads decode together, each the next that nobody has."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numba.np.numpy_support import carray
from numpy.typing import NDArray

from datagen.recording.jpeg.compiled import compiled
from datagen.recording.jpeg.picture import decoded
from datagen.recording.jpeg.vectors import bytes_from, take_next


@dataclass(frozen=True)
class Lot:
    """Pictures that start with `head`, for `rows` (n,) of a batch, at `addresses` (n,) of memory,
    `lengths` (n,) bytes long. `pictures` keeps them there; `taken` (1,) of them are in work."""

    head: bytes
    rows: NDArray[np.int64]
    addresses: NDArray[np.int64]
    lengths: NDArray[np.int64]
    taken: NDArray[np.int64]
    pictures: Sequence[NDArray[np.uint8]]

    @staticmethod
    def of(head: bytes, rows: Sequence[int], pictures: Sequence[bytes | memoryview]) -> "Lot":
        """Of pictures that start with `head`."""
        arrays = [np.frombuffer(picture, np.uint8) for picture in pictures]
        return Lot(
            head,
            np.array(rows, np.int64),
            np.array([array.__array_interface__["data"][0] for array in arrays], np.int64),
            np.array([len(array) for array in arrays], np.int64),
            np.zeros(1, np.int64),
            arrays,
        )


@compiled
def decoded_lot(  # type: ignore[no-untyped-def]
    rows, addresses, lengths, taken, start, width, height, tables, codes, places, factors, units,
    groups, planes, coefficients, samples, coded, out, done,
):  # fmt: skip
    """Pictures of a lot, while there are any, to rows of `out` (B, H * W * 3); see `decoded`."""
    while True:
        number = take_next(taken)
        if number >= len(rows):
            return
        row = rows[number]
        source = carray(bytes_from(addresses[number]), lengths[number])
        done[row] = decoded(
            source, start, width, height, tables, codes, places, factors, units,
            groups, planes, coefficients, samples, coded, out[row],
        )  # fmt: skip
        if not done[row]:
            coefficients[:] = 0
