"""Batches for training, decoded and mirrored on threads while the network computes.

A batch is a pure function of (seed, step): a resumed run sees what an unbroken one would have.
"""

import ctypes
import weakref
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from functools import lru_cache
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

import trackfeatures as tf
from mtlnet.data.augment.pipeline import change_images, changed_labels, draw_changes, fit_to
from trackfeatures.camera import CameraParameters

AHEAD = 3  # batches in the making
MAKERS = 2  # at a time: while one batch waits for its last image, the next is begun


class LabelArrays(Protocol):
    """The labels training needs; see `datagen.recording.Labels`."""

    @property
    def distances(self) -> NDArray[np.float32]:
        """(N, 5) m, NaN where absent."""

    @property
    def angle(self) -> NDArray[np.float32]:
        """(N,) rad."""

    @property
    def heading(self) -> NDArray[np.int64]:
        """(N,) classes."""


class Images(Protocol):
    """Labelled images; `datagen.recording.Frames` is one."""

    def __len__(self) -> int: ...

    @property
    def labels(self) -> LabelArrays: ...

    def read_batch(
        self, indices: NDArray[np.int64], out: NDArray[np.uint8]
    ) -> NDArray[np.uint8]: ...


@dataclass(frozen=True)
class Batch:
    """`images` (B, H, W, 3) uint8, `coded` (B, 6), `heading` (B,)."""

    images: NDArray[np.uint8]
    coded: NDArray[np.float32]
    heading: NDArray[np.int64]


class Loader:
    """Endless batches from `frames`, each epoch in its own order.

    `part` (which, of how many): makes that part of each batch of `batch` images, as whole.
    """

    def __init__(
        self,
        frames: Images,
        camera: CameraParameters,
        batch: int,
        seed: int,
        *,
        augment: bool,
        part: tuple[int, int] = (0, 1),
    ) -> None:
        self.frames = frames
        self.batch = batch
        self.seed = seed
        self.augment = augment
        self.camera = camera
        which, parts = part
        self.rows = slice(which * batch // parts, (which + 1) * batch // parts)
        shape = (self.rows.stop - self.rows.start, camera.height, camera.width, 3)
        self._memory = BufferPool(shape)
        labels = frames.labels
        self.coded = tf.encode(labels.distances, labels.angle)
        self.heading = np.asarray(labels.heading, dtype=np.int64)
        self._permutation = lru_cache(maxsize=2)(self._shuffle)

    def _shuffle(self, epoch: int) -> NDArray[np.int64]:
        return np.random.default_rng([self.seed, 1, epoch]).permutation(len(self.heading))

    def indices(self, step: int) -> NDArray[np.int64]:
        """The frames of the whole batch `step`; every frame once an epoch."""
        places = np.arange(step * self.batch, (step + 1) * self.batch)
        epochs, rows = np.divmod(places, len(self.heading))
        parts = [self._permutation(e)[rows[epochs == e]] for e in np.unique(epochs).tolist()]
        return np.concatenate(parts)

    def make(self, step: int) -> Batch:
        """This part of batch number `step`."""
        chosen = self.indices(step)[self.rows]
        images = self._memory.take()
        self.frames.read_batch(chosen, images)
        heading = self.heading[chosen]
        if not self.augment:
            return Batch(images, self.coded[chosen], heading)
        rng = np.random.default_rng([self.seed, 2, step])
        size = (self.camera.height, self.camera.width)
        labels = self.frames.labels
        distances, angle = labels.distances[chosen], labels.angle[chosen]
        changes = fit_to(draw_changes(self.batch, *size, rng).take(self.rows), distances)
        change_images(images, changes, self.camera)
        coded, heading = changed_labels(distances, angle, heading, changes, self.camera)
        return Batch(images, coded, heading)

    def batches(self, first: int) -> Iterator[Batch]:
        """Batches `first`, `first` + 1, ... without end, made ahead on threads."""
        with ThreadPoolExecutor(MAKERS, thread_name_prefix="loader") as pool:
            waiting: list[Future[Batch]] = [pool.submit(self.make, first + i) for i in range(AHEAD)]
            step = first + AHEAD
            try:
                while True:
                    batch = waiting.pop(0).result()
                    waiting.append(pool.submit(self.make, step))
                    step += 1
                    yield batch
            finally:
                for future in waiting:
                    future.cancel()


# Memory for batches that is used again: a new one costs a page fault every 4 KB.


class BufferPool:
    """uint8 arrays of one shape; the memory of one that nobody refers to any more is lent again.

    There are never more than were in use at the same time.
    """

    def __init__(self, shape: tuple[int, ...]) -> None:
        self._shape = shape
        self._kind = ctypes.c_ubyte * int(np.prod(shape))
        self._free: list[NDArray[np.uint8]] = []

    def take(self) -> NDArray[np.uint8]:
        """An array; what it holds is anything."""
        try:
            memory = self._free.pop()
        except IndexError:
            memory = np.empty(ctypes.sizeof(self._kind), np.uint8)
        # Every view of the array keeps this alive, whatever becomes of the array itself.
        lent = self._kind.from_buffer(memory.data)
        weakref.finalize(lent, self._free.append, memory).atexit = False
        array: NDArray[np.uint8] = np.frombuffer(memoryview(lent), np.uint8).reshape(self._shape)
        return array
