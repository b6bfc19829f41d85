"""What all workers of a service see at once: one piece of memory, inherited by file descriptor.

Cells are 64-bit words, each written by one process or, in the tables, by any: a word is stored in
one instruction, so a reader sees the old or the new one, never half of each. Layout, in words:
the head, a block for each worker slot, the table of streams, the table of clients.
"""

import mmap
import os
import tempfile
from dataclasses import dataclass

HEAD_WORDS = 8
WORKER_WORDS = 256
STREAM_SLOTS, STREAM_WORDS = 1024, 2
CLIENT_SLOTS, CLIENT_WORDS = 1024, 3
COMMITTED = 0  # word of the head: the generation of weights that all workers are to answer with


@dataclass(frozen=True)
class Shared:
    """The memory of a service with `slots` worker slots, and the descriptor it is inherited by."""

    fd: int
    slots: int
    memory: mmap.mmap

    def head(self) -> "memoryview[int]":
        """The unsigned words of the head."""
        return self._part(0, HEAD_WORDS).cast("Q")

    def worker(self, slot: int) -> "memoryview[float]":
        """The reals of a worker's block: its counts, see `serve.metrics`."""
        return self._part(HEAD_WORDS + slot * WORKER_WORDS, WORKER_WORDS).cast("d")

    def streams(self) -> "memoryview[int]":
        """The unsigned words of the table of streams, see `serve.streams`."""
        first = HEAD_WORDS + self.slots * WORKER_WORDS
        return self._part(first, STREAM_SLOTS * STREAM_WORDS).cast("Q")

    def clients(self) -> "memoryview[float]":
        """The reals of the table of clients, see `serve.rate`."""
        first = HEAD_WORDS + self.slots * WORKER_WORDS + STREAM_SLOTS * STREAM_WORDS
        return self._part(first, CLIENT_SLOTS * CLIENT_WORDS).cast("d")

    def _part(self, first: int, count: int) -> "memoryview[int]":
        return memoryview(self.memory)[8 * first : 8 * (first + count)]


def create(slots: int) -> Shared:
    """New memory, all zero, that child processes may inherit."""
    if hasattr(os, "memfd_create"):
        fd = os.memfd_create("driverview-serve", 0)
    else:  # not Linux: a file that has no name any more
        with tempfile.TemporaryFile() as file:
            fd = os.dup(file.fileno())
    os.ftruncate(fd, _size(slots))
    os.set_inheritable(fd, True)
    return attach(fd, slots)


def attach(fd: int, slots: int) -> Shared:
    """The memory behind an inherited descriptor."""
    return Shared(fd, slots, mmap.mmap(fd, _size(slots)))


def _size(slots: int) -> int:
    tables = STREAM_SLOTS * STREAM_WORDS + CLIENT_SLOTS * CLIENT_WORDS
    return 8 * (HEAD_WORDS + slots * WORKER_WORDS + tables)
