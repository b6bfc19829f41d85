"""The two directions of a link: a sender that owns a block of the memory, a receiver that reads it.

Who sends fills `record` (and `image`), then calls `send`; who receives finds both as the newest
whole message left them.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from simulator.link.layout import IMAGE_OFFSET, MESSAGE_ALIGNMENT, STATE, Block
from simulator.link.segment import Segment
from simulator.link.sync import futex
from simulator.link.sync.seqlock import DAMAGED, NOTHING, publish, spin, take

SPINS = 30_000
"""Looks before sleeping: about 20 us, what it takes to be woken from a sleep."""


class _Place:
    """Where the messages of one direction lie: shared words, our own copy of them, a picture."""

    def __init__(self, segment: Segment, block: Block, image_bytes: int) -> None:
        shared = segment.bytes()
        words = shared[block.offset : block.end].view(np.uint64)
        picture = shared[IMAGE_OFFSET : IMAGE_OFFSET + image_bytes].view(np.uint64)
        message = np.zeros(1, block.dtype)
        local_picture = np.zeros(image_bytes // MESSAGE_ALIGNMENT, np.uint64)
        self.record: Any = message[0]
        """The message by field names, as a row of `block.dtype`."""
        self.image: NDArray[np.uint8] = local_picture.view(np.uint8)
        self.sequence = words.view(np.uint32)[:1]
        self.arrays = self.sequence, words, message.view(np.uint64), picture, local_picture
        self.address = int(self.sequence.ctypes.data)


class Sender:
    """The only writer of `block`."""

    def __init__(self, segment: Segment, block: Block, image_bytes: int = 0) -> None:
        self._place = _Place(segment, block, image_bytes)
        self.record, self.image = self._place.record, self._place.image

    def send(self) -> None:
        publish(*self._place.arrays)
        self.wake()

    def wake(self) -> None:
        """Let the receiver look up, although there is no message."""
        futex.wake(self._place.address)


class Receiver:
    """Reads `block` without disturbing its writer; many may."""

    def __init__(self, segment: Segment, block: Block, image_bytes: int = 0) -> None:
        self._place = _Place(segment, block, image_bytes)
        self._seen = 0
        self.damaged = False
        self.record, self.image = self._place.record, self._place.image

    def poll(self) -> bool:
        """Whether there was a message newer than the last; it is in `record` then.

        `damaged` says that its checksum is wrong: its writer does not keep to the protocol.
        """
        outcome, self._seen = take(*self._place.arrays, self._seen)
        self.damaged = outcome == DAMAGED
        return bool(outcome != NOTHING)

    def wait(self, seconds: float) -> bool:
        """As `poll`, but wait up to about `seconds` for a message: briefly awake, then asleep."""
        current = int(spin(self._place.sequence, self._seen, SPINS))
        if current == self._seen or current & 1:
            futex.wait(self._place.address, current, seconds)
        return self.poll()


def state_image_bytes(segment: Segment) -> int:
    """Bytes of the picture that a segment's state messages carry."""
    return len(segment.memory) - STATE.end
