"""The memory for bodies: what all requests of all workers together may hold.

Each worker writes the bytes that it holds into its block of the shared memory; there is no lock, so
that two workers at once may exceed the budget by a body each. While the budget is used up, bodies
that arrive slowly give way to small ones: else a few clients that hold back the last bytes of large
bodies would keep all others out.
"""

from collections.abc import Callable

from serve.api.problems import OVERLOADED, Problem
from serve.workers.shared_memory import BODY_BYTES, SharedMemory

SMALL_BYTES = 256 << 10  # of a body for which slow ones give way; most images have fewer


class BodyBudget:
    """The bytes of bodies in flight: received, and not yet answered."""

    def __init__(self, shared: SharedMemory, block: int, limit: int) -> None:
        """`limit`: bytes of all workers together; `block`: this worker's."""
        blocks = [shared.worker(number) for number in range(shared.blocks)]
        self._own = blocks[block]
        self._own[BODY_BYTES] = 0.0  # of a worker that had this block before
        self._others = [cells for number, cells in enumerate(blocks) if number != block]
        self._limit = limit
        self.held = 0
        self.end_slow_bodies: Callable[[float], float] = lambda _size: 0.0
        """Ends requests of this worker whose bodies arrive slowly, until so many bytes are free, or
        soon will be; how many."""

    def take(self, size: int, small: bool) -> None:
        """Hold `size` bytes more. Raises Problem when that is over the budget.

        `small`: slow bodies give way to this one.
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
        """By how many bytes the budget is exceeded with `size` bytes more."""
        others = sum(cells[BODY_BYTES] for cells in self._others)
        return self.held + size + others - self._limit

    def give_back(self, size: int) -> None:
        """Hold `size` bytes fewer."""
        self.held -= size
        self._own[BODY_BYTES] = self.held


class BodyShare:
    """What one request holds of the budget. Call `close` when it is answered or given up."""

    __slots__ = ("_budget", "size")

    def __init__(self, budget: BodyBudget) -> None:
        self._budget = budget
        self.size = 0

    def grow(self, size: int) -> None:
        """Hold `size` bytes more. Raises Problem."""
        self._budget.take(size, self.size + size <= SMALL_BYTES)
        self.size += size

    def hold(self, size: int) -> None:
        """Hold `size` bytes in all. Raises Problem."""
        if size > self.size:
            self.grow(size - self.size)
        elif size < self.size:
            self._budget.give_back(self.size - size)
            self.size = size

    def close(self) -> None:
        """Hold nothing; may be called twice."""
        if self.size:
            self._budget.give_back(self.size)
            self.size = 0
