"""Reading a dataset folder: its rounds, their labels as arrays, their images as uint8 batches.

frames = Dataset.open("datasets/default").select("train")
batch = frames.read_batch([3, 1, 2])
"""

import hashlib
import os
from bisect import bisect_right
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property
from itertools import accumulate
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

import trackfeatures as tf
from datagen.recording.errors import DatasetError, UndecodableImage
from datagen.recording.images import decode_into
from datagen.recording.labels import Labels, concatenate, read_labels
from datagen.recording.mcap.index import RoundIndex, open_round
from datagen.recording.mcap.protobuf_wire import bytes_field
from datagen.recording.round_metadata import RoundInfo
from datagen.recording.schema.topics import CAMERA
from datagen.recording.splits import (
    DEFAULT_SPLIT,
    SIDES,
    RoundKey,
    Split,
    read_split,
    require_disjoint,
    require_known_recovered,
    split_path,
)
from trackfeatures.camera import CameraParameters

if TYPE_CHECKING:
    from datagen.recording.bulk import BulkDecoder

IMAGE_DATA = 2  # number of the field `data` of foxglove.CompressedImage
BULK = 8  # images: for fewer, compiled code is not worth loading


class Frames:
    """The frames of some rounds, in round order; labels are parsed once, images on demand."""

    def __init__(
        self,
        rounds: Sequence[RoundInfo],
        indexes: Sequence[RoundIndex],
        camera: CameraParameters,
        rows: NDArray[np.int64] | None = None,
    ) -> None:
        """`rows`: the frames of these rounds that are meant, ascending; None: all."""
        self.rounds = list(rounds)
        self.camera = camera
        self._images = [index.messages[CAMERA] for index in indexes]
        self._indexes = list(indexes)
        # The number of the first frame of each round, and of the one after the last.
        self._first = list(accumulate((len(images) for images in self._images), initial=0))
        self._rows = np.arange(self._first[-1]) if rows is None else rows

    def __len__(self) -> int:
        return len(self._rows)

    @cached_property
    def labels(self) -> Labels:
        each = concatenate([read_labels(ix, number) for number, ix in enumerate(self._indexes)])
        return each if len(self) == self._first[-1] else each.take(self._rows)

    def every(self, step: int) -> "Frames":
        """Each `step`-th of these frames, from the first on."""
        return Frames(self.rounds, self._indexes, self.camera, self._rows[::step])

    def without(self, left_out: Iterable[int]) -> "Frames":
        """These frames but those numbered `left_out`."""
        kept = np.delete(self._rows, list(left_out))
        return Frames(self.rounds, self._indexes, self.camera, kept)

    def jpeg(self, i: int) -> memoryview:
        """The encoded image of frame `i` (a PNG in rounds recorded with that codec), not copied."""
        number, frame = self._locate(i)
        try:
            return bytes_field(self._images[number].payload(frame), IMAGE_DATA)
        except ValueError as error:
            raise self._unreadable(i, error) from error

    def image(self, i: int) -> NDArray[np.uint8]:
        """The image of frame `i`, (H, W, 3) uint8 RGB; DatasetError when it cannot be decoded."""
        image: NDArray[np.uint8] = self.read_batch([i])[0]
        return image

    def read_batch(
        self, indices: Sequence[int] | NDArray[np.int64], out: NDArray[np.uint8] | None = None
    ) -> NDArray[np.uint8]:
        """Decode the images of `indices` into `out` (B, H, W, 3) uint8 RGB, on all cores.

        Returns `out`, a new array where none is given. IndexError for a frame that is not there,
        DatasetError for an image that cannot be decoded. The first batch of a process takes 0.7 s
        longer, the first on a machine some seconds: the decoder is compiled, and kept.
        """
        numbers = np.asarray(indices, dtype=np.int64)
        shape = (len(numbers), self.camera.height, self.camera.width, 3)
        out = np.empty(shape, np.uint8) if out is None else out
        if out.shape != shape or out.dtype != np.uint8:
            raise ValueError(f"`out` is {out.dtype} {out.shape}, expected uint8 {shape}")
        left = np.arange(len(numbers))
        if len(numbers) >= BULK and out.flags.c_contiguous:
            left = np.flatnonzero(~self._decode_together(numbers, out))
        if len(left):
            # One iterator for all threads: each takes the next image when it is done with its last.
            rows = zip(left.tolist(), numbers[left].tolist(), strict=True)
            self._on_all_threads(lambda: self._decode(rows, out))
        return out

    def _decode_together(
        self, numbers: NDArray[np.int64], out: NDArray[np.uint8]
    ) -> NDArray[np.bool_]:
        """Which images our own decoder has decoded, (B,)."""
        from datagen.recording.bulk import lots

        found = lots([self.jpeg(i) for i in numbers.tolist()])
        done = np.zeros(len(numbers), np.bool_)
        self._on_all_threads(lambda: self._bulk.decode(found, out, done))
        return done

    def _decode(self, rows: Iterator[tuple[int, int]], out: NDArray[np.uint8]) -> None:
        for row, i in rows:
            try:
                decode_into(self.jpeg(i), out[row])
            except ValueError as error:
                raise self._unreadable(i, error) from error

    def _on_all_threads(self, work: Callable[[], None]) -> None:
        parts = [self._pool.submit(work) for _ in range(self._threads)]
        for part_done in parts:
            part_done.result()

    def _locate(self, i: int) -> tuple[int, int]:
        if not 0 <= i < len(self):
            raise IndexError(f"frame {i} of {len(self)}")
        row = int(self._rows[i])
        number = bisect_right(self._first, row) - 1
        return number, row - self._first[number]

    def _unreadable(self, i: int, error: Exception) -> UndecodableImage:
        number, frame = self._locate(i)
        info = self.rounds[number]
        return UndecodableImage(info.id, info.path, frame, str(error))

    @cached_property
    def _threads(self) -> int:
        return len(os.sched_getaffinity(0))

    @cached_property
    def _bulk(self) -> "BulkDecoder":
        from datagen.recording.bulk import BulkDecoder  # numba takes long to load

        return BulkDecoder()

    @cached_property
    def _pool(self) -> ThreadPoolExecutor:
        return ThreadPoolExecutor(self._threads, thread_name_prefix="decode")


@dataclass(frozen=True)
class Dataset:
    """A dataset folder, opened with `Dataset.open`."""

    path: Path
    rounds: list[RoundInfo]
    camera: CameraParameters
    content_hash: str
    indexes: list[RoundIndex]

    @staticmethod
    def open(path: str | Path, split: str = DEFAULT_SPLIT) -> "Dataset":
        """Open the rounds of a folder.

        Raises DatasetError when there are none, one is damaged, cameras differ or the split leaks,
        and DefinitionsMismatch when they were recorded under other definitions.
        """
        folder = Path(path)
        indexes = [open_round(file) for file in round_files(folder)]
        for index in indexes:
            tf.require_version(index.header.definitions, str(index.path))
        chosen = read_split(split_path(folder, split))
        _require_sound_split(chosen, indexes)
        rounds = [
            RoundInfo.of(ix.path, ix.header, ix.result, chosen.side(ix.header.id)) for ix in indexes
        ]
        content_hash = dataset_hash(info.content_hash for info in rounds)
        return Dataset(folder, rounds, _one_camera(indexes), content_hash, indexes)

    def select(self, side: str = "all") -> Frames:
        """The frames of the train, the test or the unseen rounds, or of all."""
        if side not in (*SIDES, "all"):
            raise DatasetError(
                f"there is no side {side!r} of a split; choose {', '.join(SIDES)} or all"
            )
        chosen = [i for i, info in enumerate(self.rounds) if side in (info.split, "all")]
        if not chosen:
            raise DatasetError(
                f"{self.path} has {len(self.rounds)} rounds but none for {side}; collect more "
                "rounds (every fourth becomes a test round; `datagen collect --split unseen` makes "
                "unseen ones) or choose another split"
            )
        return Frames(
            [self.rounds[i] for i in chosen], [self.indexes[i] for i in chosen], self.camera
        )


def round_files(folder: Path) -> list[Path]:
    """The finished rounds of a dataset folder, in order; DatasetError when there are none."""
    files = sorted((folder / "rounds").glob("*.mcap"))
    if not files:
        raise DatasetError(
            f"{folder} holds no recorded rounds (expected {folder}/rounds/*.mcap); make some with "
            f"`datagen collect --out {folder}`"
        )
    return files


def _require_sound_split(split: Split, indexes: Sequence[RoundIndex]) -> None:
    require_known_recovered(split, indexes)
    require_disjoint(
        split, [RoundKey(ix.header.id, ix.header.seed, ix.result.content_hash) for ix in indexes]
    )


def _one_camera(indexes: Sequence[RoundIndex]) -> CameraParameters:
    """The camera all rounds are of; in a dataset with jitter each round's differs a little."""
    camera = indexes[0].header.dataset_camera
    for index in indexes:
        if index.header.dataset_camera != camera:
            raise DatasetError(
                f"the rounds were recorded with different cameras: {indexes[0].path.name} with "
                f"{camera}, {index.path.name} with {index.header.dataset_camera}; keep them apart"
            )
    return camera


def dataset_hash(content_hashes: Iterable[str]) -> str:
    """One hash over the images and labels of all rounds, whatever their order and names."""
    digest = hashlib.sha256(tf.VERSION.encode())
    for content in sorted(content_hashes):
        digest.update(content.encode())
    return digest.hexdigest()
