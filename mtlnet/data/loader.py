"""Batches for training, decoded and augmented on threads while the network computes.

A batch is a pure function of (seed, step): a resumed run gets the same batches as one without
interruption.
"""

import ctypes
import weakref
from collections import deque
from collections.abc import Callable, Generator, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import lru_cache
from itertools import count
from typing import Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

import trackfeatures as tf
from datagen.recording import Frames
from mtlnet.data.augment.pipeline import (
    AugmentParams,
    apply_params,
    augment_labels,
    draw_params,
    resolve_lateral_shift,
)
from mtlnet.data.model_labels import model_labels
from trackfeatures.camera import CameraParameters

PREFETCH = 3  # batches made or waiting
WORKERS = 2  # threads: while one waits for the last image of its batch, the other starts the next


Made = TypeVar("Made")


class LabelArrays(Protocol):
    """Labels for training; `datagen.recording.Labels` has them."""

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


class AheadLabels(Protocol):
    """Labels of the road ahead; `mtlnet.data.road_ahead.RoadAhead` is one."""

    def labels(
        self, indices: NDArray[np.int64], params: AugmentParams | None = None
    ) -> NDArray[np.float32]:
        """(B, A) for frames augmented with `params`."""


@dataclass(frozen=True)
class Batch:
    """`images` (B, H, W, 3) uint8, `coded` (B, 6), `heading` (B,), `ahead` (B, A)."""

    images: NDArray[np.uint8]
    coded: NDArray[np.float32]
    heading: NDArray[np.int64]
    ahead: NDArray[np.float32]
    """Labels of the road ahead: no columns, or those of `mtlnet.model.auxiliary`."""


@dataclass(frozen=True)
class BatchLabels:
    """A batch without its images: which frames, their augmentation, and the labels after it."""

    chosen: NDArray[np.int64]  # (B,)
    params: AugmentParams | None
    coded: NDArray[np.float32]  # (B, 6)
    heading: NDArray[np.int64]  # (B,)
    ahead: NDArray[np.float32]  # (B, A)


class Loader:
    """Endless batches from `frames`, shuffled anew in each epoch.

    `part` (index, count): makes only that part of each batch of `batch` images, for one of several
    processes; the images are those of the whole batch. `repeats` (N,): how often each frame occurs
    in an epoch; without it once.
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
        ahead: AheadLabels | None = None,
        repeats: NDArray[np.int64] | None = None,
    ) -> None:
        self.frames = frames
        self.batch = batch
        self.seed = seed
        self.augment = augment
        self.camera = camera
        self._ahead = ahead
        index, parts = part
        self.rows = slice(index * batch // parts, (index + 1) * batch // parts)
        shape = (self.rows.stop - self.rows.start, camera.height, camera.width, 3)
        self._buffers = BufferPool(shape)
        # Of varied roads the camera's height differs from round to round.
        labels = model_labels(frames) if isinstance(frames, Frames) else frames.labels
        self._labels = labels
        self.coded = tf.encode(labels.distances, labels.angle)
        self.heading = np.asarray(labels.heading, dtype=np.int64)
        each = np.arange(len(self.heading))
        self._epoch = each if repeats is None else np.repeat(each, repeats)
        self._permutation = lru_cache(maxsize=2)(self._shuffle)

    def _shuffle(self, epoch: int) -> NDArray[np.int64]:
        return np.random.default_rng([self.seed, 1, epoch]).permutation(self._epoch)

    def indices(self, step: int) -> NDArray[np.int64]:
        """Rows of `frames` in the whole batch `step`."""
        places = np.arange(step * self.batch, (step + 1) * self.batch)
        epochs, rows = np.divmod(places, len(self._epoch))
        parts = [self._permutation(e)[rows[epochs == e]] for e in np.unique(epochs).tolist()]
        return np.concatenate(parts)

    def make(self, step: int) -> Batch:
        """This process's part of batch `step`."""
        labels = self.make_labels(step)
        images = self._buffers.take()
        self.frames.read_batch(labels.chosen, images)
        if labels.params is not None:
            apply_params(images, labels.params, self.camera)
        return Batch(images, labels.coded, labels.heading, labels.ahead)

    def make_labels(self, step: int) -> BatchLabels:
        """The same without its images."""
        chosen = self.indices(step)[self.rows]
        heading = self.heading[chosen]
        if not self.augment:
            return BatchLabels(chosen, None, self.coded[chosen], heading, self.read_ahead(chosen))
        rng = np.random.default_rng([self.seed, 2, step])
        size = (self.camera.height, self.camera.width)
        labels = self._labels
        distances, angle = labels.distances[chosen], labels.angle[chosen]
        drawn = draw_params(self.batch, *size, rng).take(self.rows)
        params = resolve_lateral_shift(drawn, distances)
        coded, heading = augment_labels(distances, angle, heading, params, self.camera)
        return BatchLabels(chosen, params, coded, heading, self.read_ahead(chosen, params))

    def read_ahead(
        self, chosen: NDArray[np.int64], params: AugmentParams | None = None
    ) -> NDArray[np.float32]:
        """Labels of the road ahead (B, A) of frames augmented with `params`."""
        if self._ahead is None:
            return np.zeros((len(chosen), 0), np.float32)
        return self._ahead.labels(chosen, params)

    def batches(self, first: int) -> Iterator[Batch]:
        """Batches `first`, `first` + 1, ... without end, made in advance on threads."""
        return make_ahead(self.make, first, PREFETCH, WORKERS)


def make_ahead(
    make: Callable[[int], Made], first: int, ahead: int, workers: int
) -> Generator[Made, None, None]:
    """make(first), make(first + 1), ... without end, on threads, `ahead` made or waiting."""
    with ThreadPoolExecutor(workers, thread_name_prefix="loader") as pool:
        waiting = deque(pool.submit(make, first + i) for i in range(ahead))
        try:
            for step in count(first + ahead):
                made = waiting.popleft().result()
                waiting.append(pool.submit(make, step))
                yield made
        finally:
            for future in waiting:
                future.cancel()


class BufferPool:
    """uint8 arrays of one shape whose memory is reused once no array or view refers to it.

    Fresh memory costs a page fault every 4 KiB. There are never more buffers than were in use at
    the same time.
    """

    def __init__(self, shape: tuple[int, ...]) -> None:
        self._shape = shape
        self._buffer_type = ctypes.c_ubyte * int(np.prod(shape))
        self._free: list[NDArray[np.uint8]] = []

    def take(self) -> NDArray[np.uint8]:
        """An array with arbitrary content."""
        try:
            memory = self._free.pop()
        except IndexError:
            memory = np.empty(ctypes.sizeof(self._buffer_type), np.uint8)
        # Every view of the array holds a reference to this object, which returns the memory.
        owner = self._buffer_type.from_buffer(memory.data)
        weakref.finalize(owner, self._free.append, memory).atexit = False
        array: NDArray[np.uint8] = np.frombuffer(memoryview(owner), np.uint8).reshape(self._shape)
        return array
