"""Limits for request bodies: the size of one body, and the memory of all bodies of all workers.

Each worker writes the number of bytes of its bodies into its block of the shared memory. There is
no lock, so simultaneous requests in different workers can each exceed the budget by one body. If
the budget is exhausted, requests whose bodies arrive slowly are ended in favour of bodies of up to
256 KiB (SMALL_BYTES). Otherwise a few clients that withhold the last bytes of large bodies could
block all other clients.
"""

from collections.abc import Callable

from serve.config import MAX_BODY_BYTES
from serve.problems import OVERLOADED, Problem, body_too_large
from serve.shared_memory import BODY_BYTES, SharedMemory

SMALL_BYTES = 256 << 10  # slow bodies are ended for a body of up to this size; most images fit


class BodyBudget:
    """Counts the bytes of bodies in flight: received, but not yet answered."""

    def __init__(self, shared: SharedMemory, block: int, limit: int) -> None:
        """`block` is this worker's block of `shared`; `limit` in bytes is for all workers."""
        blocks = [shared.worker(number) for number in range(shared.blocks)]
        self._own = blocks[block]
        self._own[BODY_BYTES] = 0.0  # overwrites the count of the worker that had this block before
        self._others = [cells for number, cells in enumerate(blocks) if number != block]
        self._limit = limit
        self.held = 0
        self.end_slow_bodies: Callable[[float], float] = lambda _size: 0.0
        """Ends requests of this worker whose bodies arrive slowly, until the given number of bytes
        is free or will soon be free; returns the number of freed bytes."""

    def take(self, size: int, small: bool) -> None:
        """Reserve `size` more bytes. Raises Problem if they exceed the budget.

        `small`: whether the whole body has at most 256 KiB (SMALL_BYTES) so far; if it is true,
        requests whose bodies arrive slowly are ended to make room.
        """
        excess = self._excess(size)
        if excess > 0 and not (small and self.end_slow_bodies(excess) >= excess):
            raise Problem(
                OVERLOADED,
                f"the bodies in flight need more than {self._limit >> 20} MiB; send this one later",
            )
        self.held += size
        self._own[BODY_BYTES] = self.held

    def _excess(self, size: int) -> float:
        """Number of bytes by which `size` more bytes would exceed the budget."""
        others = sum(cells[BODY_BYTES] for cells in self._others)
        return self.held + size + others - self._limit

    def give_back(self, size: int) -> None:
        """Release `size` bytes."""
        self.held -= size
        self._own[BODY_BYTES] = self.held


class BodyShare:
    """The bytes that one request has reserved in the budget. Call `close` when the request is
    answered or abandoned."""

    __slots__ = ("_budget", "size")

    def __init__(self, budget: BodyBudget) -> None:
        self._budget = budget
        self.size = 0

    def receive(self, size: int) -> None:
        """Reserve `size` more bytes for received bytes of the body. Raises Problem if the body is
        then too large or the budget is exhausted."""
        if self.size + size > MAX_BODY_BYTES:
            raise body_too_large(f"more than {MAX_BODY_BYTES} bytes")
        self.grow(size)

    def grow(self, size: int) -> None:
        """Reserve `size` more bytes, without a limit for a single body. Raises Problem if the
        budget is exhausted."""
        self._budget.take(size, self.size + size <= SMALL_BYTES)
        self.size += size

    def hold(self, size: int) -> None:
        """Increase or reduce the reserved size to `size` bytes. Raises Problem if the budget is
        exhausted."""
        if size > self.size:
            self.grow(size - self.size)
        elif size < self.size:
            self._budget.give_back(self.size - size)
            self.size = size

    def close(self) -> None:
        """Release all bytes; a second call has no effect."""
        if self.size:
            self._budget.give_back(self.size)
            self.size = 0
