"""What a worker tells the others, in its block of the shared memory, and what it knows of them."""

import time

from serve.shared import Shared

BEAT, CONNECTIONS, WAITING, READY = 0, 1, 2, 3  # s of the monotonic clock; numbers; 1.0 or 0.0
COUNTS = 8  # where the counts of `serve.metrics` begin
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
