"""Sends and receives the messages of a link. A message is one block of the shared memory (COMMAND
from the client, STATE from the server, see `layout`), and for STATE the camera image.

To send a message, fill the sender's `record` (and `image`, bytes (n,)) and call `send`. After a
`poll` or `wait` that returns True, the receiver's `record` and `image` contain the newest message.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from simulator.link.layout import IMAGE_OFFSET, MESSAGE_ALIGNMENT, STATE, Block
from simulator.link.segment import Segment
from simulator.link.sync import futex
from simulator.link.sync.seqlock import DAMAGED, READ, TORN, publish, spin_until_new, try_read

SPIN_COUNT = 30_000
"""Number of polls before a receiver sleeps: about 20 us, the duration of a wake-up."""


class _MessageBuffer:
    """The messages of one direction: the shared words, a local copy of them, and the image."""

    def __init__(self, segment: Segment, block: Block, image_bytes: int) -> None:
        shared = segment.bytes()
        words = shared[block.offset : block.end].view(np.uint64)
        picture = shared[IMAGE_OFFSET : IMAGE_OFFSET + image_bytes].view(np.uint64)
        message = np.zeros(1, block.dtype)
        local_picture = np.zeros(image_bytes // MESSAGE_ALIGNMENT, np.uint64)
        self.record: Any = message[0]
        """The message as a row of `block.dtype`, accessed by field names."""
        self.image: NDArray[np.uint8] = local_picture.view(np.uint8)
        self.sequence = words.view(np.uint32)[:1]
        self.arrays = self.sequence, words, message.view(np.uint64), picture, local_picture
        self.address = int(self.sequence.ctypes.data)


class Sender:
    """Writes messages to the block `block` of the segment. No other sender may write to this
    block."""

    def __init__(self, segment: Segment, block: Block, image_bytes: int = 0) -> None:
        self._buffer = _MessageBuffer(segment, block, image_bytes)
        self.record, self.image = self._buffer.record, self._buffer.image

    def send(self) -> None:
        publish(*self._buffer.arrays)
        self.wake()

    def wake(self) -> None:
        """Wake the receiver without sending a message."""
        futex.wake(self._buffer.address)


class Receiver:
    """Reads messages from `block` without blocking its writer; a block can have many receivers."""

    def __init__(self, segment: Segment, block: Block, image_bytes: int = 0) -> None:
        self._buffer = _MessageBuffer(segment, block, image_bytes)
        self._seen = 0
        self.damaged = self.torn = False
        self.record, self.image = self._buffer.record, self._buffer.image

    def poll(self) -> bool:
        """Copy the newest message into `record` and `image`, unless it was received before. Returns
        whether a message was copied.

        Sets `damaged` to True if the message has a wrong checksum, that is, if its writer violates
        the protocol. The contents of `record` are then undefined. They are undefined as well while
        `torn` is True: the writer wrote during the copy, and no message was copied.
        """
        outcome, self._seen = try_read(*self._buffer.arrays, self._seen)
        came = bool(outcome in (READ, DAMAGED))
        self.damaged = outcome == DAMAGED
        self.torn = outcome == TORN or (self.torn and not came)
        return came

    def wait(self, seconds: float) -> bool:
        """Wait at most about `seconds` for a new message and receive it as `poll` does. Returns
        whether one arrived. The function spins for about 20 us, then sleeps."""
        current = int(spin_until_new(self._buffer.sequence, self._seen, SPIN_COUNT))
        if current == self._seen or current & 1:
            futex.wait(self._buffer.address, current, seconds)
        return self.poll()


def state_image_bytes(segment: Segment) -> int:
    """Return the size in bytes of the image in a segment's state messages."""
    return len(segment.memory) - STATE.end
