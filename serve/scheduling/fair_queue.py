"""A queue of frames, and a lock, in which clients take turns.

If the queue is full, the client with the most frames in it loses one to a client with fewer frames.
A client is an IPv4 address or an IPv6 /64 network.
"""

import asyncio
from collections import Counter, deque
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mtlnet.inference.prediction import Prediction
from serve.config import network_of
from trackfeatures.camera import CameraParameters

MAX_CLIENTS = 1024  # number of clients whose last turn is remembered

PixelReader = Callable[[CameraParameters], NDArray[np.uint8]]
"""Returns the pixels (height, width, 3) uint8 RGB in the view of the model's camera."""
ResultCallback = Callable[["FrameResult | Exception"], None]


@dataclass(frozen=True, slots=True)
class FrameResult:
    """The prediction for a frame, its engine's provenance, and the time of each stage in ms."""

    prediction: Prediction
    provenance: dict[str, str]
    queue_ms: float
    decode_ms: float
    forward_ms: float


@dataclass(frozen=True, slots=True)
class Frame:
    """An image to process. Times are in ns of the monotonic clock.

    `stream` is 0 for a frame without a stream. A `small` image is decoded in less time than the
    engine takes; `cost_ms` is the estimated decoding time. `source` is the image's camera if
    its pixels are warped into the view of the model's camera.
    """

    read: PixelReader
    stamp_ns: int
    stream: int = 0
    deadline_ns: int | None = None
    small: bool = False
    client: str = ""
    cost_ms: float = 0.0
    source: CameraParameters | None = None


class Slot:
    """A place in the queue: a frame, its client, and the callback for its result."""

    __slots__ = ("client", "frame", "on_result")

    def __init__(self, frame: Frame, on_result: ResultCallback) -> None:
        self.client = network_of(frame.client)
        self.frame = frame
        self.on_result = on_result


class FairQueue:
    """Slots in the order of their arrival. Not thread-safe."""

    def __init__(self) -> None:
        self._slots: list[Slot] = []
        self._counts: Counter[str] = Counter()  # slots of each client
        self._turns: dict[str, int] = {}  # number of the latest turn of each client
        self._turn = 0
        self.count = 0
        """Number of slots."""

    @property
    def all_small(self) -> bool:
        """Whether all waiting frames are small."""
        return all(slot.frame.small for slot in self._slots)

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
        """The slot of a stream, if it has one."""
        return next((slot for slot in self._slots if slot.frame.stream == stream), None)

    def giving_way_to(self, client: str) -> Slot | None:
        """The last slot of the client with the most slots, if it has at least two more than
        `client`; else None."""
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


class FairLock:
    """A lock for the coroutines of one event loop; waiting clients take turns."""

    def __init__(self) -> None:
        self._locked = False
        # Waiting coroutines of each client; the first client is the next to get the lock.
        self._waiting: dict[str, deque[asyncio.Future[None]]] = {}

    @asynccontextmanager
    async def held(self, client: str) -> AsyncIterator[None]:
        """Wait for the lock, and hold it within the context."""
        if self._locked:
            await self._wait(network_of(client))
        self._locked = True
        try:
            yield
        finally:
            self._release()

    async def _wait(self, client: str) -> None:
        turn = asyncio.get_running_loop().create_future()
        self._waiting.setdefault(client, deque()).append(turn)
        try:
            await turn
        except asyncio.CancelledError:
            if not turn.cancelled():  # cancelled after it got the lock
                self._release()
            raise

    def _release(self) -> None:
        """Give the lock to the next waiting client, or unlock."""
        while self._waiting:
            client, turns = next(iter(self._waiting.items()))
            del self._waiting[client]
            turn = turns.popleft()
            if turns:
                self._waiting[client] = turns
            if not turn.done():
                turn.set_result(None)
                return
        self._locked = False
