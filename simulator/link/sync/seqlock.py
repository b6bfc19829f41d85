"""The sequence lock: a writer never waits, and a reader never takes a torn message for a whole one.

The sequence is odd while the writer is at work, and even, two higher, when it is done. A reader
copies the message between two looks at the sequence and throws the copy away unless both saw the
same even number. Orderings after Boehm, "Can seqlocks get along with programming language memory
models?" (MSPC 2012): relaxed atomic words, a release fence behind the odd store and an acquire
fence before the second look. Not only x86-64 is safe thereby. `c/protocol.h` does the same in C11.

Arrays: `sequence` (1,) uint32 and `shared` (n,) uint64 lie in the shared memory, over each other;
`local` (n,) uint64 is a message of our own; word 0 holds the sequence, word n-1 the checksum.
`shared_image` and `local_image` (k,) uint64 belong to the same message; k may be 0.
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

NOTHING, READ, DAMAGED = 0, 1, 2
TRIES = 100


@compiled
def checksum(message: Words) -> Any:
    """FNV-1a over words 1 to n-2; found damaged means a writer that is no such writer."""
    value = FNV_OFFSET
    for i in range(1, message.shape[0] - 1):
        value = (value ^ message[i]) * FNV_PRIME
    return value


@compiled
def publish(
    sequence: Sequence, shared: Words, local: Words, shared_image: Words, local_image: Words
) -> None:
    """Write `local` and its picture. Only one process may, which the link's locks see to.

    A writer that was killed half-way left an odd number: it is taken up from there.
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
def take(
    sequence: Sequence,
    shared: Words,
    local: Words,
    shared_image: Words,
    local_image: Words,
    seen: int,
) -> tuple[int, int]:
    """Copy the message into `local` if it is whole and newer than sequence `seen`.

    Returns (NOTHING, READ or DAMAGED, its sequence). Gives up after TRIES, so never blocks; with
    NOTHING or DAMAGED, what `local` holds is of no use.
    """
    for _ in range(TRIES):
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
    return NOTHING, seen


@compiled
def spin(sequence: Sequence, seen: int, turns: int) -> Any:
    """Look up to `turns` times for a finished message other than `seen`; the sequence seen last."""
    current = load_acquire(sequence, 0)
    for _ in range(turns):
        if current != seen and not current & 1:
            break
        current = load_acquire(sequence, 0)
    return current


@compiled
def set_word(word: Sequence, value: int) -> None:
    """Store a single word, after all that was written before it."""
    store_release(word, 0, np.uint32(value))


@compiled
def get_word(word: Sequence) -> Any:
    """Load a single word, before all that is read after it."""
    return load_acquire(word, 0)
