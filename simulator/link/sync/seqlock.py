"""A sequence lock: the writer never waits, and a reader never accepts a torn message.

The sequence number is odd during a write, and even afterwards; each write increases it by two. A
reader copies the message between two reads of the sequence, and discards the copy unless both reads
gave the same even number. The memory orderings are taken from Boehm, "Can seqlocks get along with
programming language memory models?" (MSPC 2012): relaxed atomic words, a release fence after the
odd store and an acquire fence before the second read. These orderings are correct on all
architectures. `c/protocol.h` does the same in C11.

Arrays: `sequence` (1,) uint32 and `shared` (n,) uint64 are views of the same shared memory. `local`
(n,) uint64 is a local copy of the message; word 0 is the sequence, word n-1 the checksum.
`shared_image` and `local_image` (k,) uint64 are the message's image in the shared memory and its
local copy; k may be 0.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from runtime.jit import compiled
from simulator.link.sync.atomics import (
    fence_acquire,
    fence_release,
    load_acquire,
    load_relaxed,
    store_relaxed,
    store_release,
)

Words = NDArray[np.uint64]
Sequence = NDArray[np.uint32]

FNV_OFFSET, FNV_PRIME = np.uint64(0xCBF29CE484222325), np.uint64(0x100000001B3)

NOTHING, READ, DAMAGED, TORN = 0, 1, 2, 3
MAX_TRIES = 100


@compiled
def checksum(message: Words) -> Any:
    """Return the FNV-1a checksum (uint64) of words 1 to n-2 of a message (n,). If it differs from
    word n-1, the writer has violated the protocol."""
    value = FNV_OFFSET
    for i in range(1, message.shape[0] - 1):
        value = (value ^ message[i]) * FNV_PRIME
    return value


@compiled
def publish(
    sequence: Sequence, shared: Words, local: Words, shared_image: Words, local_image: Words
) -> None:
    """Write `local` and its image to the shared memory. Only one process may write; the link's
    locks ensure that.

    A writer killed during a write leaves an odd sequence; the next writer continues from it.
    """
    last = local.shape[0] - 1
    local[last] = checksum(local)
    begun = load_relaxed(sequence, 0) | np.uint32(1)
    store_relaxed(sequence, 0, np.uint32(begun))
    fence_release()
    for i in range(1, last + 1):
        store_relaxed(shared, i, local[i])
    for i in range(local_image.shape[0]):
        store_relaxed(shared_image, i, local_image[i])
    store_release(sequence, 0, np.uint32(begun + np.uint32(1)))


@compiled
def try_read(
    sequence: Sequence,
    shared: Words,
    local: Words,
    shared_image: Words,
    local_image: Words,
    seen: int,
) -> tuple[int, int]:
    """Copy the message into `local` if it is complete and newer than the sequence number `seen`.

    Returns (NOTHING, READ, DAMAGED or TORN; sequence number of the message). The function gives up
    after 100 tries, so it never blocks. TORN: the writer wrote during a copy, and the function gave
    up. After DAMAGED and TORN the contents of `local` are undefined; NOTHING leaves them unchanged.
    """
    outcome = NOTHING
    for _ in range(MAX_TRIES):
        begun = load_acquire(sequence, 0)
        if begun == seen:
            return NOTHING, seen
        if begun & 1:
            continue
        for i in range(1, local.shape[0]):
            local[i] = load_relaxed(shared, i)
        for i in range(local_image.shape[0]):
            local_image[i] = load_relaxed(shared_image, i)
        fence_acquire()
        if load_relaxed(sequence, 0) == begun:
            whole = checksum(local) == local[local.shape[0] - 1]
            return (READ if whole else DAMAGED), int(begun)
        outcome = TORN
    return outcome, seen


@compiled
def spin_until_new(sequence: Sequence, seen: int, turns: int) -> Any:
    """Poll the sequence up to `turns` times until it is even and not `seen`; returns the last value
    read."""
    current = load_acquire(sequence, 0)
    for _ in range(turns):
        if current != seen and not current & 1:
            break
        current = load_acquire(sequence, 0)
    return current


@compiled
def set_word(word: Sequence, value: int) -> None:
    """Store a single word with release order: earlier writes become visible before it."""
    store_release(word, 0, np.uint32(value))


@compiled
def get_word(word: Sequence) -> Any:
    """Load a single word with acquire order: later reads happen after it."""
    return load_acquire(word, 0)
