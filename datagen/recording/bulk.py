"""Decoding many pictures of the same kind: one compiled call a thread, whatever their number.

Python between the pictures would make threads wait for each other: only one at a time may run it.
Where our decoder has nothing to say (PNG, another kind of JPEG, damage), the general one is left to
decide.
"""

import threading
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from datagen.recording.images import JPEG_MAGIC, Buffer
from datagen.recording.jpeg.decoder import Decoder
from datagen.recording.jpeg.lot import Lot
from datagen.recording.jpeg.tables import OtherKindError, head_length

MOST_HEADS = 8
"""Rounds have one; with a new one for each picture, making tables would take longer than reading.
"""


class BulkDecoder(threading.local):
    """Each thread has its own decoders."""

    def __init__(self) -> None:
        self._decoders: dict[bytes, Decoder | None] = {}

    def decode(self, lots: Sequence[Lot], out: NDArray[np.uint8], done: NDArray[np.bool_]) -> None:
        """This thread's share of `lots` into rows of `out` (B, H, W, 3); `done` (B,) says which.

        Other threads may be at the same lots: each takes the next picture that nobody has.
        """
        for lot in lots:
            decoder = self._decoder(lot.head)
            if decoder is not None:
                decoder.decode_lot(lot, out, done)

    def _decoder(self, head: bytes) -> Decoder | None:
        if head not in self._decoders:
            if len(self._decoders) >= MOST_HEADS:
                return None
            self._decoders[head] = _made(head)
        return self._decoders[head]


def lots(pictures: Sequence[Buffer]) -> list[Lot]:
    """Those that may be of our kind, by their heads."""
    rows: dict[bytes, list[int]] = {}
    head = b""
    for row, data in enumerate(pictures):
        if not head or data[: len(head)] != head:
            head = bytes(data[: head_length(data)]) if data[:2] == JPEG_MAGIC else b""
        if head:
            rows.setdefault(head, []).append(row)
    return [
        Lot.of(head, chosen, [pictures[row] for row in chosen]) for head, chosen in rows.items()
    ]


def _made(head: bytes) -> Decoder | None:
    try:
        return Decoder(head)
    except OtherKindError:
        return None
