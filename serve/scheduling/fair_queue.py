"""A queue of frames in which clients take turns.

If the queue is full, a new frame of a client with few frames replaces a frame of the client with
the most frames.
A client is an IPv4 address or an IPv6 /64 network.
"""

from collections import Counter

from serve.config import network_of
from serve.scheduling.frame import Frame, ResultCallback

MAX_CLIENTS = 1024  # number of clients whose last turn is remembered
PRESENT_NS = 1_000_000_000  # a client counts as present for this time after each of its frames


class Slot:
    """An entry of the queue: a frame, its client, and the callback for its result."""

    __slots__ = ("client", "frame", "on_result")

    def __init__(self, frame: Frame, on_result: ResultCallback) -> None:
        self.client = network_of(frame.client)
        self.frame = frame
        self.on_result = on_result


class FairQueue:
    """A queue with one slot for each waiting frame, in the order of arrival. Not thread-safe."""

    def __init__(self) -> None:
        self._slots: list[Slot] = []
        self._counts: Counter[str] = Counter()  # slots of each client
        self._turns: dict[str, int] = {}  # number of the latest turn of each client
        self._turn = 0
        self._newest: tuple[str, int] = ("", -PRESENT_NS)  # latest client, time in ns
        self._other: tuple[str, int] = ("", -PRESENT_NS)  # the client before `_newest`, time in ns
        self.count = 0
        """Number of slots."""

    @property
    def all_small(self) -> bool:
        """Whether all waiting frames are small."""
        return all(slot.frame.small for slot in self._slots)

    def note(self, client: str, now_ns: int) -> None:
        """Record that a client has sent a frame at `now_ns`, also if the frame is then refused."""
        client = network_of(client)
        if client != self._newest[0]:
            self._other = self._newest
        self._newest = (client, now_ns)

    def others_present(self, client: str, now_ns: int) -> bool:
        """Whether a client other than `client` has sent a frame within the last second
        (PRESENT_NS)."""
        same = self._newest[0] == network_of(client)
        latest_ns = (self._other if same else self._newest)[1]
        return now_ns - latest_ns < PRESENT_NS

    def append(self, slot: Slot) -> None:
        """Append a slot."""
        self._slots.append(slot)
        self._counts[slot.client] += 1
        self.count += 1

    def remove(self, slot: Slot) -> None:
        """Remove a slot."""
        self._slots.remove(slot)
        self._discount(slot)

    def of_stream(self, stream: int) -> Slot | None:
        """Return the slot of a stream's waiting frame; None if no frame of the stream waits."""
        return next((slot for slot in self._slots if slot.frame.stream == stream), None)

    def giving_way_to(self, client: str) -> Slot | None:
        """Return the slot that a full queue removes to make room for a frame of `client`: the
        newest slot of the client with the most slots. None unless that client has at least two
        slots more than `client`."""
        counts = self._counts
        most = max(counts.values(), default=0)
        if most < counts[network_of(client)] + 2:
            return None
        return next(slot for slot in reversed(self._slots) if counts[slot.client] == most)

    def take(self) -> Slot:
        """Remove and return the oldest slot of the client whose last turn is longest ago."""
        slots, turns = self._slots, self._turns
        one_client = len(self._counts) == 1
        slot = slots.pop(
            0 if one_client else min(range(len(slots)), key=lambda n: turns.get(slots[n].client, 0))
        )
        self._discount(slot)
        self._turn += 1
        turns.pop(slot.client, None)
        while len(turns) >= MAX_CLIENTS:
            turns.pop(next(iter(turns)))
        turns[slot.client] = self._turn
        return slot

    def _discount(self, slot: Slot) -> None:
        self.count -= 1
        self._counts[slot.client] -= 1
        if not self._counts[slot.client]:
            del self._counts[slot.client]
