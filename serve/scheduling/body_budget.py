"""The memory for bodies: what all requests of all workers together may hold.

Each worker writes the bytes that it holds into its block of the shared memory; there is no lock, so
that two workers at once may exceed the budget by a body each.
"""

from serve.api.problems import OVERLOADED, Problem
from serve.workers.shared_memory import BODY_BYTES, SharedMemory


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

    def take(self, size: int) -> None:
        """Hold `size` bytes more. Raises Problem when that is over the budget."""
        held = self.held + size
        if held + sum(cells[BODY_BYTES] for cells in self._others) > self._limit:
            raise Problem(
                OVERLOADED,
                f"the bodies in flight need more than {self._limit >> 20} MiB; send this one later",
            )
        self.held = held
        self._own[BODY_BYTES] = held

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
        self._budget.take(size)
        self.size += size

    def close(self) -> None:
        """Hold nothing; may be called twice."""
        if self.size:
            self._budget.give_back(self.size)
            self.size = 0
