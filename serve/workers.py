"""What a worker tells the others, in its block of the shared memory, and what it knows of them."""

import time

from serve.shared import Shared

BEAT, CONNECTIONS, WAITING = 0, 1, 2  # s of the monotonic clock; numbers
COUNTS = 8  # where the counts of `serve.metrics` begin
SILENT_S = 1.0  # a worker that has said nothing for so long may be gone


class BlockPeers:
    """The other workers of a service, seen from the one in `slot`."""

    def __init__(self, shared: Shared, slot: int) -> None:
        self._blocks = [shared.worker(number) for number in range(shared.slots)]
        self._mine = self._blocks[slot]
        self._others = [block for number, block in enumerate(self._blocks) if number != slot]

    def tell(self, connections: int) -> None:
        """Say that this worker is alive and has so many connections."""
        self._mine[CONNECTIONS] = connections
        self._mine[BEAT] = time.monotonic()

    def leave(self) -> None:
        """Say that this worker takes no more connections."""
        self._mine[BEAT] = self._mine[CONNECTIONS] = self._mine[WAITING] = 0.0

    def others(self) -> list[int]:
        """The connections of each of the other workers that are alive."""
        since = time.monotonic() - SILENT_S
        return [int(block[CONNECTIONS]) for block in self._others if block[BEAT] > since]
