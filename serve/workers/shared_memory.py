"""What all workers of a service see at once: one piece of memory, inherited by file descriptor.

Cells are 64-bit words, each written by one process or, in the tables, by any: a word is stored in
one instruction, so a reader sees the old or the new one, never half of each. Layout, in words:
the head, a block for each worker slot, the table of streams, the table of clients.
"""

import mmap
import os
import tempfile
import time
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
        """The reals of a worker's block: its counts, see `serve.observability.metrics`."""
        return self._part(HEAD_WORDS + slot * WORKER_WORDS, WORKER_WORDS).cast("d")

    def streams(self) -> "memoryview[int]":
        """The unsigned words of the table of streams, see `serve.scheduling.streams`."""
        first = HEAD_WORDS + self.slots * WORKER_WORDS
        return self._part(first, STREAM_SLOTS * STREAM_WORDS).cast("Q")

    def clients(self) -> "memoryview[float]":
        """The reals of the table of clients, see `serve.scheduling.rate_limit`."""
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


# What a worker tells the others, in its block of the shared memory, and what it knows of them.


BEAT, CONNECTIONS, WAITING, READY = 0, 1, 2, 3  # s of the monotonic clock; numbers; 1.0 or 0.0
COUNTS = 8  # where the counts of `serve.observability.metrics` begin
SILENT_S = 1.0  # a worker that has said nothing for so long may be gone


class BlockPeers:
    """The other workers of a service, seen from the one in `slot`."""

    def __init__(self, shared: Shared, slot: int) -> None:
        self._blocks = [shared.worker(number) for number in range(shared.slots)]
        self._mine = self._blocks[slot]
        self._others = [block for number, block in enumerate(self._blocks) if number != slot]

    def tell(self, connections: int, ready: bool) -> None:
        """Say that this worker is alive, has so many connections, and whether it can answer."""
        self._mine[CONNECTIONS] = connections
        self._mine[READY] = ready
        self._mine[BEAT] = time.monotonic()

    def leave(self) -> None:
        """Say that this worker takes no more connections."""
        for cell in (BEAT, CONNECTIONS, WAITING, READY):
            self._mine[cell] = 0.0

    def others(self) -> list[int]:
        """The connections of each of the other workers that are alive."""
        return [int(block[CONNECTIONS]) for block in self._alive()]

    def other_is_ready(self) -> bool:
        """Whether another worker can answer."""
        return any(block[READY] for block in self._alive())

    def _alive(self) -> list["memoryview[float]"]:
        since = time.monotonic() - SILENT_S
        return [block for block in self._others if block[BEAT] > since]
