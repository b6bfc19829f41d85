"""The two directions of a link: a sender writes a block of the shared memory, a receiver reads it.

A sender fills `record` (and `image`) and calls `send`. A receiver's `record` and `image` hold the
newest complete message.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from simulator.link.layout import IMAGE_OFFSET, MESSAGE_ALIGNMENT, STATE, Block
from simulator.link.segment import Segment
from simulator.link.sync import futex
from simulator.link.sync.seqlock import DAMAGED, NOTHING, publish, spin_until_new, try_read

SPIN_COUNT = 30_000
"""Polls before sleeping: about 20 us, as long as a wake-up takes."""


class _MessageBuffer:
    """The messages of one direction: the shared words, a local copy of them, and the image."""

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
        self._buffer = _MessageBuffer(segment, block, image_bytes)
        self.record, self.image = self._buffer.record, self._buffer.image

    def send(self) -> None:
        publish(*self._buffer.arrays)
        self.wake()

    def wake(self) -> None:
        """Wake the receiver without a message."""
        futex.wake(self._buffer.address)


class Receiver:
    """Reads `block` without blocking its writer; a block can have any number of receivers."""

    def __init__(self, segment: Segment, block: Block, image_bytes: int = 0) -> None:
        self._buffer = _MessageBuffer(segment, block, image_bytes)
        self._seen = 0
        self.damaged = False
        self.record, self.image = self._buffer.record, self._buffer.image

    def poll(self) -> bool:
        """Whether a newer message arrived; it is then in `record`.

        `damaged` is True if its checksum is wrong: the writer then violates the protocol.
        """
        outcome, self._seen = try_read(*self._buffer.arrays, self._seen)
        self.damaged = outcome == DAMAGED
        return bool(outcome != NOTHING)

    def wait(self, seconds: float) -> bool:
        """As `poll`, but wait up to about `seconds` for a message: spin briefly, then sleep."""
        current = int(spin_until_new(self._buffer.sequence, self._seen, SPIN_COUNT))
        if current == self._seen or current & 1:
            futex.wait(self._buffer.address, current, seconds)
        return self.poll()


def state_image_bytes(segment: Segment) -> int:
    """Size in bytes of the image in a segment's state messages."""
    return len(segment.memory) - STATE.end
