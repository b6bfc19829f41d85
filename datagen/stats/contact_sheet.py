"""Contact sheet of a dataset: frames spread over its tracks and lights, with their true markings.

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

from datagen.recording.dataset import Dataset, Frames
from datagen.recording.labels import light_per_frame
from datagen.recording.mcap.index import RoundIndex
from datagen.recording.round_metadata import RoundInfo
from datagen.recording.schema.topics import ANNOTATIONS, CAMERA

Image = NDArray[np.uint8]

SCALE = 2
"""Factor by which frames are enlarged, so that thin lines stay thin."""
_GREEN = (40, 255, 80)


@dataclass(frozen=True)
class Card:
    """A frame of the contact sheet."""

    image: Image
    """(2 H, 2 W, 3) uint8 RGB."""
    about: str
    caption: str


def contact_sheet(dataset: Dataset, most: int = 24) -> Iterator[Card]:
    """Up to `most` frames, one a round; rounds of tracks and lights not shown yet come first."""
    chosen = _diverse_order(dataset.rounds)[:most]
    for place, number in enumerate(chosen):
        info, index = dataset.rounds[number], dataset.indexes[number]
        # Multiples of the golden ratio: evenly spread over the places in a round.
        frame = int((place * 0.6180339887498949 % 1.0) * info.frames)
        image = Frames([info], [index], dataset.camera).image(frame)
        yield _card(info, index, frame, image)


def _diverse_order(rounds: list[RoundInfo]) -> list[int]:
    """The indices of all rounds; each next one shares the fewest properties with those before."""
    left, order = list(range(len(rounds))), list[int]()
    seen: dict[tuple[str, str | int], int] = {}
    while left:
        properties = {n: _properties(rounds[n]) for n in left}
        best = min(left, key=lambda n: sum(seen.get(p, 0) for p in properties[n]))
        for item in properties[best]:
            seen[item] = seen.get(item, 0) + 1
        order.append(best)
        left.remove(best)
    return order


def _properties(info: RoundInfo) -> tuple[tuple[str, str | int], ...]:
    return (("track", info.track), ("light", info.light), ("lanes", info.lanes))


def _card(info: RoundInfo, index: RoundIndex, frame: int, image: Image) -> Card:
    annotations = _annotations(info.path, int(index.messages[CAMERA].log_time[frame]))
    big = cv2.resize(image, None, fx=SCALE, fy=SCALE, interpolation=cv2.INTER_LINEAR)
    for line in annotations.points:
        points = np.array([(p.x, p.y) for p in line.points]) * SCALE
        cv2.polylines(big, [np.round(points).astype(np.int32)], False, _GREEN, 1, cv2.LINE_AA)
    lanes = f"{info.lanes} lane{'s' if info.lanes > 1 else ''}"
    light = light_per_frame(index)[frame]
    about = f"{info.id} #{frame} ({info.split or 'no side'}): {info.track}, {lanes}, {light}"
    caption = annotations.texts[0].text if annotations.texts else ""
    return Card(np.asarray(big, np.uint8), about, caption)


def _annotations(path: Path, log_time: int) -> ImageAnnotations:
    """The annotations of the image recorded at `log_time` (ns)."""
    with path.open("rb") as file:
        reader = make_reader(file)
        for _, _, message in reader.iter_messages(
            [ANNOTATIONS], starting_at=log_time, ending_at=log_time
        ):
            return ImageAnnotations.FromString(message.data)
    return ImageAnnotations()
