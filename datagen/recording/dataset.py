"""Reads a dataset folder: rounds, labels as arrays, images as uint8 batches.

frames = Dataset.open("datasets/default").select("train")
batch = frames.read_batch([3, 1, 2])
"""

import hashlib
import os
from bisect import bisect_right
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from dataclasses import dataclass
from functools import cached_property
from itertools import accumulate
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import trackfeatures as tf
from datagen.recording.errors import DatasetError, UndecodableImage
from datagen.recording.folder import require_merged
from datagen.recording.images import decode_into
from datagen.recording.labels import Labels, concatenate, read_labels
from datagen.recording.mcap.index import RoundIndex, open_round
from datagen.recording.mcap.protobuf_wire import bytes_field
from datagen.recording.names import SIDES
from datagen.recording.round_metadata import RoundInfo
from datagen.recording.schema.topics import CAMERA, EGO_STATE, LABELS
from datagen.recording.splits import (
    DEFAULT_SPLIT,
    RoundKey,
    read_split,
    require_disjoint,
    require_recovered_declared,
    split_path,
)
from trackfeatures.camera import CameraParameters

IMAGE_DATA = 2  # number of the field `data` of foxglove.CompressedImage


class Frames:
    """The frames of some rounds, in the order of the rounds.

    Labels are parsed at the first access and kept; an image is decoded at each access.
    """

    def __init__(
        self,
        rounds: Sequence[RoundInfo],
        indexes: Sequence[RoundIndex],
        camera: CameraParameters,
        rows: NDArray[np.int64] | None = None,
    ) -> None:
        """`indexes` are the opened files of `rounds`. `rows`: ascending indices of the frames to
        use, counted over all frames of `rounds`; None: all frames."""
        self.rounds = list(rounds)
        self.camera = camera
        self._images = [index.messages[CAMERA] for index in indexes]
        self._indexes = list(indexes)
        # Index of the first frame of each round, counted over all rounds; at the end the total.
        self._first = list(accumulate((len(images) for images in self._images), initial=0))
        self._rows = np.arange(self._first[-1]) if rows is None else rows

    def __len__(self) -> int:
        return len(self._rows)

    @cached_property
    def labels(self) -> Labels:
        """The labels of these frames. Raises DatasetError if a label is damaged or missing."""
        if len(self) == self._first[-1]:
            return concatenate([read_labels(ix, n) for n, ix in enumerate(self._indexes)])
        places = self.places()
        return concatenate(
            [
                read_labels(index, number, places[places[:, 0] == number, 1])
                for number, index in enumerate(self._indexes)
            ]
        )

    def require_label(self, i: int) -> None:
        """Raise UndecodableImage unless the label and the state of frame `i` can be read."""
        number, frame = self._locate(i)
        for topic in (LABELS, EGO_STATE):
            try:
                self._indexes[number].messages[topic].payload(frame)
            except (ValueError, IndexError) as error:
                raise self._undecodable(i, error) from error

    def every(self, step: int) -> "Frames":
        """Return every `step`-th of these frames, starting with the first."""
        return Frames(self.rounds, self._indexes, self.camera, self._rows[::step])

    def without(self, excluded: Iterable[int]) -> "Frames":
        """Return these frames except those with the indices `excluded`."""
        kept = np.delete(self._rows, list(excluded))
        return Frames(self.rounds, self._indexes, self.camera, kept)

    def places(self) -> NDArray[np.int64]:
        """Return the position of each frame (N, 2): index of its round in `rounds`, number of the
        frame in that round."""
        number = np.searchsorted(self._first, self._rows, "right") - 1
        return np.column_stack([number, self._rows - np.array(self._first)[number]])

    def jpeg(self, i: int) -> memoryview:
        """Return the encoded image of frame `i`, not copied: a JPEG, or a PNG in a lossless round.

        Raises IndexError, or UndecodableImage if the recorded message of the image is damaged.
        """
        number, frame = self._locate(i)
        try:
            return bytes_field(self._images[number].payload(frame), IMAGE_DATA)
        except ValueError as error:
            raise self._undecodable(i, error) from error

    def image(self, i: int) -> NDArray[np.uint8]:
        """Decode and return the image of frame `i`, (H, W, 3) uint8 RGB. Raises IndexError or
        UndecodableImage."""
        image: NDArray[np.uint8] = self.read_batch([i])[0]
        return image

    def read_batch(
        self, indices: Sequence[int] | NDArray[np.int64], out: NDArray[np.uint8] | None = None
    ) -> NDArray[np.uint8]:
        """Decode the images of the frames `indices` (B,) on one thread per core.

        Returns them as (B, H, W, 3) uint8 RGB: in `out`, or in a new array. Raises IndexError for a
        frame that does not exist, UndecodableImage for a damaged image (the rest of `out` is then
        undefined), and ValueError if `out` has another shape or type, is read-only, or has images
        that are not C-contiguous.
        """
        numbers = np.asarray(indices, dtype=np.int64)
        shape = (len(numbers), self.camera.height, self.camera.width, 3)
        out = np.empty(shape, np.uint8) if out is None else out
        if out.shape != shape or out.dtype != np.uint8:
            raise ValueError(f"`out` is {out.dtype} {out.shape}, expected uint8 {shape}")
        if not out.flags.writeable or not all(image.flags.c_contiguous for image in out[:1]):
            raise ValueError("`out` is read-only or has gaps within an image; give another array")
        absent = numbers[(numbers < 0) | (numbers >= len(self))]
        if len(absent):
            raise IndexError(f"frame {absent[0]} of {len(self)}")
        # One iterator for all threads: each thread takes the next image when it is free.
        rows = iter(enumerate(numbers.tolist()))
        threads = min(self._threads, len(numbers))
        parts = [self._pool.submit(self._decode, rows, out) for _ in range(threads)]
        wait(parts)  # after an error no thread may still be writing to `out`
        errors = [error for part in parts if (error := part.result()) is not None]
        if errors:
            raise min(errors)[1]
        return out

    def _decode(
        self, rows: Iterator[tuple[int, int]], out: NDArray[np.uint8]
    ) -> tuple[int, UndecodableImage] | None:
        """Decode images into `out` until `rows`, pairs (row of `out`, frame), ends or an image is
        damaged. Returns the row and the error of the damaged image, else None."""
        for row, i in rows:
            try:
                decode_into(self.jpeg(i), out[row])
            except UndecodableImage as error:
                return row, error
            except ValueError as error:
                return row, self._undecodable(i, error)
        return None

    def _locate(self, i: int) -> tuple[int, int]:
        """The round of frame `i` (an index into `rounds`), and the frame's number in this round."""
        if not 0 <= i < len(self):
            raise IndexError(f"frame {i} of {len(self)}")
        row = int(self._rows[i])
        number = bisect_right(self._first, row) - 1
        return number, row - self._first[number]

    def _undecodable(self, i: int, error: Exception) -> UndecodableImage:
        number, frame = self._locate(i)
        info = self.rounds[number]
        return UndecodableImage(info.id, info.path, frame, str(error))

    @cached_property
    def _threads(self) -> int:
        return len(os.sched_getaffinity(0))

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
        """Open the dataset in the folder `path` with the split `split`.

        Raises DatasetError if it has no rounds, a round is damaged or in two files, a merge has not
        ended, cameras differ or the split leaks, and DefinitionsMismatch if a round was recorded
        under other label definitions.
        """
        folder = Path(path)
        indexes = open_rounds(folder)
        for index in indexes:
            tf.require_version(index.header.definitions, str(index.path))
        chosen = read_split(split_path(folder, split))
        require_recovered_declared(chosen, indexes, split_path(folder, split))
        require_disjoint(
            chosen,
            [RoundKey(ix.header.id, ix.header.seed, ix.result.content_hash) for ix in indexes],
        )
        rounds = [
            RoundInfo.of(ix.path, ix.header, ix.result, chosen.side(ix.header.id)) for ix in indexes
        ]
        content_hash = dataset_hash(info.content_hash for info in rounds)
        return Dataset(folder, rounds, _one_camera(indexes), content_hash, indexes)

    def select(self, side: str = "all") -> Frames:
        """Return the frames of the rounds on one side of the split (train, test, unseen), or of all
        rounds ("all"). Raises DatasetError if there are none."""
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
    """Return the paths of the finished rounds of a dataset folder, sorted by name.

    Raises DatasetError if there are none, or if a merge into the folder has not ended.
    """
    require_merged(folder)
    files = sorted((folder / "rounds").glob("*.mcap"))
    if not files:
        raise DatasetError(
            f"{folder} holds no recorded rounds (expected {folder}/rounds/*.mcap); make some with "
            f"`datagen collect --out {folder}`"
        )
    return files


def open_rounds(folder: Path) -> list[RoundIndex]:
    """Open the finished rounds of a dataset folder, sorted by file name. Raises DatasetError if
    there are none, a round is damaged, or two files hold the same round."""
    found: dict[str, RoundIndex] = {}
    for file in round_files(folder):
        index = open_round(file)
        first = found.setdefault(index.header.id, index)
        if first is not index:
            raise DatasetError(
                f"{first.path} and {file} both hold round {index.header.id}; keep one of them, "
                f"named {index.header.id}.mcap"
            )
    return list(found.values())


def _one_camera(indexes: Sequence[RoundIndex]) -> CameraParameters:
    """Return the camera of the dataset, that is, the camera of all its rounds without jitter.
    `indexes` are the opened rounds. Raises DatasetError if the rounds have different cameras."""
    camera = indexes[0].header.dataset_camera
    for index in indexes:
        if index.header.dataset_camera != camera:
            raise DatasetError(
                f"the rounds were recorded with different cameras: {indexes[0].path.name} with "
                f"{camera}, {index.path.name} with {index.header.dataset_camera}; keep them apart"
            )
    return camera


def dataset_hash(content_hashes: Iterable[str]) -> str:
    """Compute the SHA-256 (hex) over the content hashes of all rounds. Their order has no
    effect."""
    digest = hashlib.sha256(tf.VERSION.encode())
    for content in sorted(content_hashes):
        digest.update(content.encode())
    return digest.hexdigest()
