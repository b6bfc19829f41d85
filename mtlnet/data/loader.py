"""Makes training batches: decodes and augments images on threads while the network computes.

A batch is a pure function of (seed, step), so a resumed run gets the same batches as an
uninterrupted one.
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

PREFETCH = 3  # batches made in advance
WORKERS = 2  # threads: one starts the next batch while the other waits for its last image


Made = TypeVar("Made")


class LabelArrays(Protocol):
    """Interface of the labels for training; `datagen.recording.Labels` implements it."""

    @property
    def distances(self) -> NDArray[np.float32]:
        """Distances (N, 5) in m, NaN where absent, infinity where the label is unknown."""

    @property
    def angle(self) -> NDArray[np.float32]:
        """Angles (N,) in rad."""

    @property
    def heading(self) -> NDArray[np.int64]:
        """Numbers (N,) of the class of the road (`trackfeatures.RoadClass`)."""


class Images(Protocol):
    """Interface of labelled images; `datagen.recording.Frames` implements it."""

    def __len__(self) -> int: ...

    @property
    def labels(self) -> LabelArrays: ...

    def read_batch(
        self, indices: NDArray[np.int64], out: NDArray[np.uint8]
    ) -> NDArray[np.uint8]: ...


class AheadLabels(Protocol):
    """Interface of the labels of the road ahead; `mtlnet.data.road_ahead.RoadAhead` implements
    it."""

    def labels(
        self, indices: NDArray[np.int64], params: AugmentParams | None = None
    ) -> NDArray[np.float32]:
        """Return the labels of the road ahead (B, A) of the frames `indices` (B,), augmented with
        `params`. A is 28: 20 image columns (px) and 8 curvatures (1/m)."""


@dataclass(frozen=True)
class Batch:
    """Images uint8 (B, H, W, 3) with their labels: the coded distances and angle `coded` (B, 6),
    the `RoadClass` numbers `heading` (B,), and the labels of the auxiliary heads `ahead`."""

    images: NDArray[np.uint8]
    coded: NDArray[np.float32]
    heading: NDArray[np.int64]
    ahead: NDArray[np.float32]
    """Labels of the road ahead (B, A). A is 0 without auxiliary heads, else
    `mtlnet.model.auxiliary.LABELS`."""


@dataclass(frozen=True)
class BatchLabels:
    """A batch without its images: the row numbers of its frames (`chosen`), their augmentation
    parameters (None without augmentation), and their labels after the augmentation."""

    chosen: NDArray[np.int64]  # (B,)
    params: AugmentParams | None
    coded: NDArray[np.float32]  # (B, 6)
    heading: NDArray[np.int64]  # (B,)
    ahead: NDArray[np.float32]  # (B, A)


class Loader:
    """Makes batches of `batch` images of `frames` without end, shuffled again in each epoch.

    `part`: index of this process and number of processes; each process makes its part of every
    batch. `ahead`: labels of the road ahead; None: batches without them. `repeats` (N,): number of
    times that each frame occurs in an epoch; None: once.
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
        # On varied roads the height of the camera differs between rounds, so `model_labels`
        # converts the labels to metres at the model's camera.
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
        """Return the row numbers (batch,) of the frames of batch `step`, of all processes."""
        places = np.arange(step * self.batch, (step + 1) * self.batch)
        epochs, rows = np.divmod(places, len(self._epoch))
        parts = [self._permutation(e)[rows[epochs == e]] for e in np.unique(epochs).tolist()]
        return np.concatenate(parts)

    def make(self, step: int) -> Batch:
        """Return this process's part of batch `step`."""
        labels = self.make_labels(step)
        images = self._buffers.take()
        self.frames.read_batch(labels.chosen, images)
        if labels.params is not None:
            apply_params(images, labels.params, self.camera)
        return Batch(images, labels.coded, labels.heading, labels.ahead)

    def make_labels(self, step: int) -> BatchLabels:
        """Return this process's part of batch `step`, without its images."""
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
        """Return the labels of the road ahead (B, A) of the frames `chosen` (B,), augmented with
        `params`; A is 0 if the loader has no labels of the road ahead, else 28."""
        if self._ahead is None:
            return np.zeros((len(chosen), 0), np.float32)
        return self._ahead.labels(chosen, params)

    def batches(self, first: int) -> Iterator[Batch]:
        """Yield batches `first`, `first` + 1, ... without end, made in advance on threads."""
        return make_ahead(self.make, first, PREFETCH, WORKERS)


def make_ahead(
    make: Callable[[int], Made], first: int, ahead: int, workers: int
) -> Generator[Made, None, None]:
    """Yield make(first), make(first + 1), ... without end. `workers` threads compute up to `ahead`
    results in advance."""
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
    """uint8 arrays of one shape, whose memory is reused once no array or view refers to it.

    Fresh memory costs one page fault per 4 KiB. The pool never holds more buffers than were in use
    at the same time.
    """

    def __init__(self, shape: tuple[int, ...]) -> None:
        self._shape = shape
        self._buffer_type = ctypes.c_ubyte * int(np.prod(shape))
        self._free: list[NDArray[np.uint8]] = []

    def take(self) -> NDArray[np.uint8]:
        """Return a free buffer, or a new one if none is free, as an array with arbitrary
        content."""
        try:
            memory = self._free.pop()
        except IndexError:
            memory = np.empty(ctypes.sizeof(self._buffer_type), np.uint8)
        # Every view of the array holds a reference to this object, which returns the memory.
        owner = self._buffer_type.from_buffer(memory.data)
        weakref.finalize(owner, self._free.append, memory).atexit = False
        array: NDArray[np.uint8] = np.frombuffer(memoryview(owner), np.uint8).reshape(self._shape)
        return array
