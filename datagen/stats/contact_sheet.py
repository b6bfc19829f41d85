"""Frames of a dataset to look at, spread over its tracks and lights, true markings drawn on them.

The markings are the recorded ones (topic /camera/front/annotations), in pixels.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from foxglove_schemas_protobuf.ImageAnnotations_pb2 import ImageAnnotations
from mcap.reader import make_reader
from numpy.typing import NDArray

from datagen.recording.dataset import Dataset
from datagen.recording.images import decode_into
from datagen.recording.labels import light_per_frame
from datagen.recording.mcap.index import RoundIndex
from datagen.recording.mcap.protobuf_wire import bytes_field
from datagen.recording.round_metadata import RoundInfo
from datagen.recording.schema.topics import ANNOTATIONS, CAMERA

Image = NDArray[np.uint8]

IMAGE_DATA = 2  # number of the field `data` of foxglove.CompressedImage
SCALE = 2
"""Frames are shown this much larger, so that thin lines stay thin."""
_GREEN = (40, 255, 80)


@dataclass(frozen=True)
class Card:
    """A frame of the sheet."""

    image: Image
    """(2 H, 2 W, 3) uint8 RGB."""
    about: str
    caption: str


def contact_sheet(dataset: Dataset, most: int = 24) -> Iterator[Card]:
    """Up to `most` frames: each round's turn comes after those whose track and light are rarer."""
    chosen = _spread(dataset.rounds)[:most]
    for turn, number in enumerate(chosen):
        info, index = dataset.rounds[number], dataset.indexes[number]
        frame = int((turn * 0.6180339887498949 % 1.0) * info.frames)  # anywhere in the round
        yield _card(info, index, frame, (dataset.camera.height, dataset.camera.width))


def _spread(rounds: list[RoundInfo]) -> list[int]:
    """Numbers of all rounds, those first that differ most from the ones before them."""
    left, order = list(range(len(rounds))), list[int]()
    seen: dict[tuple[str, str | int], int] = {}
    while left:
        kinds = {n: _kinds(rounds[n]) for n in left}
        best = min(left, key=lambda n: sum(seen.get(kind, 0) for kind in kinds[n]))
        for kind in kinds[best]:
            seen[kind] = seen.get(kind, 0) + 1
        order.append(best)
        left.remove(best)
    return order


def _kinds(info: RoundInfo) -> tuple[tuple[str, str | int], ...]:
    return (("track", info.track), ("light", info.light), ("lanes", info.lanes))


def _card(info: RoundInfo, index: RoundIndex, frame: int, size: tuple[int, int]) -> Card:
    data = bytes_field(index.messages[CAMERA].payload(frame), IMAGE_DATA)
    image = np.empty((*size, 3), np.uint8)
    decode_into(data, image)
    notes = _annotations(info.path, int(index.messages[CAMERA].log_time[frame]))
    big = cv2.resize(image, None, fx=SCALE, fy=SCALE, interpolation=cv2.INTER_LINEAR)
    for line in notes.points:
        points = np.array([(p.x, p.y) for p in line.points]) * SCALE
        cv2.polylines(big, [np.round(points).astype(np.int32)], False, _GREEN, 1, cv2.LINE_AA)
    lanes = f"{info.lanes} lane{'s' if info.lanes > 1 else ''}"
    light = light_per_frame(index)[frame]
    about = f"{info.id} #{frame} ({info.split or 'no side'}): {info.track}, {lanes}, {light}"
    return Card(np.asarray(big, np.uint8), about, notes.texts[0].text if notes.texts else "")


def _annotations(path: Path, log_time: int) -> ImageAnnotations:
    """What was drawn over the image of this moment."""
    with path.open("rb") as file:
        reader = make_reader(file)
        for _, _, message in reader.iter_messages(
            [ANNOTATIONS], starting_at=log_time, ending_at=log_time
        ):
            return ImageAnnotations.FromString(message.data)
    return ImageAnnotations()
