"""Decoding many pictures of the same kind: a decoder for each thread, kept for the next picture.

Where ours has nothing to say (PNG, another kind of JPEG, damage) the general one decides.
"""

import threading

import numpy as np
from numpy.typing import NDArray

from .encoding import JPEG_MAGIC, Buffer, decode_into
from .jpeg.decoder import Decoder
from .jpeg.tables import OtherKindError, head_length

MOST_HEADS = 8
"""Rounds have one; with a new one for each picture, making tables would take longer than reading.
"""


class BulkDecoder(threading.local):
    """Each thread has its own decoders."""

    def __init__(self) -> None:
        self._decoders: dict[bytes, Decoder | None] = {}
        self._last = b""

    def decode_into(self, data: Buffer, out: NDArray[np.uint8]) -> None:
        """As `encoding.decode_into`, and with the same answer, in less time."""
        decoder = self._decoder(data)
        if decoder is None or not decoder.decode(data, out):
            decode_into(data, out)

    def _decoder(self, data: Buffer) -> Decoder | None:
        if not self._last or data[: len(self._last)] != self._last:
            if data[:2] != JPEG_MAGIC:
                return None
            head = bytes(data[: head_length(data)])
            if head not in self._decoders:
                if len(self._decoders) >= MOST_HEADS:
                    return None
                self._decoders[head] = _made(head)
            self._last = head
        return self._decoders.get(self._last)


def _made(head: bytes) -> Decoder | None:
    try:
        return Decoder(head)
    except OtherKindError:
        return None
