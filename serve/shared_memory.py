"""The memory that all workers of a service share, and its layout.

Cells are 64-bit words. A word is written in one instruction, so a reader gets the old or the new
value, never a mixture; there are no locks. The parts of the memory, in this order:

    head            8 unsigned integers; the supervisor writes them
    worker blocks   256 floats each; one worker owns and writes each block
    stream table    1024 x (key, newest time stamp in ns), unsigned; all workers write
    client table    1024 x (key, remaining tokens, time of the last update in s), floats;
                    all workers write

Both tables are hash tables with open addressing: a key is in one of 8 consecutive entries, which
start at its hash.
"""

import mmap
import os
import tempfile
import time
from dataclasses import dataclass

HEAD_WORDS = 8
COMMITTED_GENERATION = 0  # head: the generation of weights that all workers use

WORKER_WORDS = 256
HEARTBEAT, CONNECTIONS, WAITING, READY = 0, 1, 2, 3  # monotonic s; counts; 1.0 or 0.0
BODY_BYTES = 4  # bytes of bodies in flight
ROOM_ASKED, ROOM_FOR = 5, 6  # number of calls of `ask_for_room`; `least` of the latest call
MAX_OUTCOMES = 64
STAGES, STAGE_WORDS = 4, 16
FRAME_COUNTS = 8  # MAX_OUTCOMES counters: frames by outcome
CLOSED_COUNTS = FRAME_COUNTS + MAX_OUTCOMES  # MAX_OUTCOMES counters: closed connections by reason
HISTOGRAMS = CLOSED_COUNTS + MAX_OUTCOMES  # STAGES x STAGE_WORDS: buckets, then the sum in s

STREAM_ENTRIES, STREAM_WORDS = 1024, 2
CLIENT_ENTRIES, CLIENT_WORDS = 1024, 3
PROBES = 8

HEARTBEAT_TIMEOUT_S = 1.0  # a worker with an older heartbeat counts as dead


@dataclass(frozen=True)
class SharedMemory:
    """The memory of a service with `blocks` worker blocks; `fd` is its file descriptor.

    The methods return views of its parts; writing to a view writes to the memory.
    """

    fd: int
    blocks: int
    memory: mmap.mmap

    @property
    def workers(self) -> int:
        """The number of workers; a replacement that runs beside its predecessor is not counted."""
        return max(1, self.blocks - 1)

    def head(self) -> "memoryview[int]":
        """Return the head: unsigned integers (8,)."""
        return self._words(0, HEAD_WORDS).cast("Q")

    def worker(self, block: int) -> "memoryview[float]":
        """Return the worker block with number `block`: floats (256,)."""
        return self._words(HEAD_WORDS + block * WORKER_WORDS, WORKER_WORDS).cast("d")

    def streams(self) -> "memoryview[int]":
        """Return the stream table: unsigned integers (2048,), a key and a time stamp for each
        entry."""
        first = HEAD_WORDS + self.blocks * WORKER_WORDS
        return self._words(first, STREAM_ENTRIES * STREAM_WORDS).cast("Q")

    def clients(self) -> "memoryview[float]":
        """Return the client table: floats (3072,), a key, tokens and a time for each entry."""
        first = HEAD_WORDS + self.blocks * WORKER_WORDS + STREAM_ENTRIES * STREAM_WORDS
        return self._words(first, CLIENT_ENTRIES * CLIENT_WORDS).cast("d")

    def _words(self, first: int, count: int) -> "memoryview[int]":
        return memoryview(self.memory)[8 * first : 8 * (first + count)]


def create_shared_memory(blocks: int) -> SharedMemory:
    """Create zeroed memory with `blocks` worker blocks; child processes inherit its descriptor."""
    if hasattr(os, "memfd_create"):
        fd = os.memfd_create("driverview-serve", 0)
    else:  # not Linux: use an unlinked file
        with tempfile.TemporaryFile() as file:
            fd = os.dup(file.fileno())
    os.ftruncate(fd, _size_bytes(blocks))
    os.set_inheritable(fd, True)
    return attach_shared_memory(fd, blocks)


def attach_shared_memory(fd: int, blocks: int) -> SharedMemory:
    """Map the shared memory with `blocks` worker blocks that has the inherited descriptor `fd`."""
    return SharedMemory(fd, blocks, mmap.mmap(fd, _size_bytes(blocks)))


def _size_bytes(blocks: int) -> int:
    tables = STREAM_ENTRIES * STREAM_WORDS + CLIENT_ENTRIES * CLIENT_WORDS
    return 8 * (HEAD_WORDS + blocks * WORKER_WORDS + tables)


class WorkerPeers:
    """The status of a worker and of its peers: heartbeat, connections, readiness."""

    def __init__(self, shared: SharedMemory, block: int) -> None:
        """`block` is the number of this worker's block."""
        blocks = [shared.worker(number) for number in range(shared.blocks)]
        self._own = blocks[block]
        self._others = [cells for number, cells in enumerate(blocks) if number != block]
        self._room_asked = [cells[ROOM_ASKED] for cells in self._others]

    def publish(self, connections: int, ready: bool) -> None:
        """Write this worker's status and heartbeat."""
        self._own[CONNECTIONS] = connections
        self._own[READY] = ready
        self._own[HEARTBEAT] = time.monotonic()

    def withdraw(self) -> None:
        """Clear this worker's status, because it accepts no more connections."""
        for cell in (HEARTBEAT, CONNECTIONS, WAITING, READY, BODY_BYTES):
            self._own[cell] = 0.0

    def other_connections(self) -> list[int]:
        """Return the number of open connections of each other live worker."""
        return [int(cells[CONNECTIONS]) for cells in self._live()]

    def ask_for_room(self, least: int) -> None:
        """Ask the worker with the most connections to end a connection of a client that has at
        least `least` connections. The worker reads this with `room_asked`."""
        self._own[ROOM_FOR] = least
        self._own[ROOM_ASKED] += 1

    def room_asked(self) -> int | None:
        """Return the smallest `least` that other workers have passed to `ask_for_room` since the
        last call of `room_asked`. Returns None if none has called it, or if another worker has more
        connections and must end one."""
        before, self._room_asked = self._room_asked, [cells[ROOM_ASKED] for cells in self._others]
        if self._own[CONNECTIONS] < max(self.other_connections(), default=0):
            return None
        each = zip(self._others, before, self._room_asked, strict=True)
        asked = (int(cells[ROOM_FOR]) for cells, old, now in each if now > old)
        return min(asked, default=None)

    def other_is_ready(self) -> bool:
        """Whether another live worker is ready to answer images."""
        return any(cells[READY] for cells in self._live())

    def _live(self) -> list["memoryview[float]"]:
        since = time.monotonic() - HEARTBEAT_TIMEOUT_S
        return [cells for cells in self._others if cells[HEARTBEAT] > since]
