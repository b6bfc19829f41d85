"""Reading a dataset folder: its rounds, their labels as arrays, their images as uint8 batches.

frames = Dataset.open("datasets/default").select("train")
batch = frames.read_batch(indices, np.empty((len(indices), 210, 280, 3), np.uint8))
"""

import hashlib
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property
from os import cpu_count
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import trackfeatures as tf

from .camera import CameraInfo
from .encoding import decode_into
from .errors import DatasetError
from .header import RoundInfo
from .index import RoundIndex, open_round
from .labels import Labels, concatenate, read_labels
from .splits import DEFAULT_SPLIT, SIDES, RoundKey, Split, read_split, require_disjoint, split_path
from .topics import CAMERA
from .wire import bytes_field

IMAGE_DATA = 2  # number of the field `data` of foxglove.CompressedImage


class Frames:
    """The frames of some rounds, in round order; labels are parsed once, images on demand."""

    def __init__(
        self, rounds: Sequence[RoundInfo], indexes: Sequence[RoundIndex], camera: CameraInfo
    ) -> None:
        self.rounds = list(rounds)
        self.camera = camera
        self._images = [index.messages[CAMERA] for index in indexes]
        self._indexes = list(indexes)
        counts = [len(images.log_time) for images in self._images]
        self._first = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)

    def __len__(self) -> int:
        return int(self._first[-1])

    @cached_property
    def labels(self) -> Labels:
        return concatenate([read_labels(ix, number) for number, ix in enumerate(self._indexes)])

    def jpeg(self, i: int) -> memoryview:
        """The encoded image of frame `i` (a PNG in rounds recorded with that codec), not copied."""
        number, frame = self._locate(i)
        try:
            return bytes_field(self._images[number].payload(frame), IMAGE_DATA)
        except ValueError as error:
            raise self._unreadable(i, error) from error

    def read_batch(
        self, indices: Sequence[int] | NDArray[np.int64], out: NDArray[np.uint8]
    ) -> NDArray[np.uint8]:
        """Decode the images of `indices` into `out` (B, H, W, 3) uint8 RGB, on threads."""
        numbers = np.asarray(indices, dtype=np.int64)
        shape = (len(numbers), self.camera.height, self.camera.width, 3)
        if out.shape != shape or out.dtype != np.uint8:
            raise ValueError(f"`out` is {out.dtype} {out.shape}, expected uint8 {shape}")
        parts = np.array_split(np.arange(len(numbers)), self._threads)
        work = [self._pool.submit(self._decode, numbers, part, out) for part in parts]
        for part_done in work:
            part_done.result()
        return out

    def _decode(
        self, numbers: NDArray[np.int64], rows: NDArray[np.int64], out: NDArray[np.uint8]
    ) -> None:
        for row in rows.tolist():
            try:
                decode_into(self.jpeg(int(numbers[row])), out[row])
            except ValueError as error:
                raise self._unreadable(int(numbers[row]), error) from error

    def _locate(self, i: int) -> tuple[int, int]:
        if not 0 <= i < len(self):
            raise IndexError(f"frame {i} of {len(self)}")
        number = int(np.searchsorted(self._first, i, side="right")) - 1
        return number, i - int(self._first[number])

    def _unreadable(self, i: int, error: Exception) -> DatasetError:
        number, frame = self._locate(i)
        return DatasetError(
            f"image {frame} of {self.rounds[number].path} cannot be read: {error}; run "
            "`datagen verify --level deep` on the dataset and record the round again"
        )

    @property
    def _threads(self) -> int:
        return cpu_count() or 1

    @cached_property
    def _pool(self) -> ThreadPoolExecutor:
        return ThreadPoolExecutor(self._threads, thread_name_prefix="decode")


@dataclass(frozen=True)
class Dataset:
    """A dataset folder, opened with `Dataset.open`."""

    path: Path
    rounds: list[RoundInfo]
    camera: CameraInfo
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
        return Dataset(folder, rounds, _one_camera(indexes), _content_hash(rounds), indexes)

    def select(self, side: str = "all") -> Frames:
        """The frames of the train rounds, the test rounds, or all."""
        if side not in (*SIDES, "all"):
            raise DatasetError(f"there is no side {side!r} of a split; choose train, test or all")
        chosen = [i for i, info in enumerate(self.rounds) if side in (info.split, "all")]
        if not chosen:
            raise DatasetError(
                f"{self.path} has {len(self.rounds)} rounds but none for {side}; collect more "
                "rounds (every fourth becomes a test round) or choose another split"
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
    require_disjoint(
        split, [RoundKey(ix.header.id, ix.header.seed, ix.result.content_hash) for ix in indexes]
    )


def _one_camera(indexes: Sequence[RoundIndex]) -> CameraInfo:
    camera = indexes[0].header.camera
    for index in indexes:
        if index.header.camera != camera:
            raise DatasetError(
                f"the rounds were recorded with different cameras: {indexes[0].path.name} with "
                f"{camera}, {index.path.name} with {index.header.camera}; keep them apart"
            )
    return camera


def _content_hash(rounds: Sequence[RoundInfo]) -> str:
    """One hash over all rounds, whatever their order."""
    digest = hashlib.sha256(tf.VERSION.encode())
    for content in sorted(info.content_hash for info in rounds):
        digest.update(content.encode())
    return digest.hexdigest()
