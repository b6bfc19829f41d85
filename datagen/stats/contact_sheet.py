"""Contact sheet of a dataset: sample frames of its tracks and lights, with their true markings.

The markings are the recorded ones (topic /camera/front/annotations), in pixels.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from datagen.recording.dataset import Dataset
from datagen.recording.images import decode_into
from datagen.recording.round_metadata import RoundInfo
from datagen.recording.schema.topics import ANNOTATIONS
from datagen.view.contents import Contents
from datagen.view.steps import TOPICS, Steps
from runtime.cli import counted

Image = NDArray[np.uint8]

SCALE = 2
"""Factor by which frames are enlarged, so that the drawn lines cover little of a frame."""
_GREEN = (40, 255, 80)


@dataclass(frozen=True)
class Card:
    """A frame of the contact sheet, with a line about its round and a line with its labels."""

    image: Image
    """(2 H, 2 W, 3) uint8 RGB."""
    about: str
    caption: str


def contact_sheet(dataset: Dataset, most: int = 24) -> Iterator[Card]:
    """Yield up to `most` frames, one per round. Rounds with tracks and lights that have not been
    shown yet come first."""
    chosen = _diverse_order(dataset.rounds)[:most]
    for place, number in enumerate(chosen):
        info = dataset.rounds[number]
        # Multiples of the golden ratio: evenly spread over the length of a round.
        frame = int((place * 0.6180339887498949 % 1.0) * info.frames)
        yield _card(info, frame, (dataset.camera.height, dataset.camera.width))


def _diverse_order(rounds: list[RoundInfo]) -> list[int]:
    """The indices of all rounds in an order in which each round shares as few properties as
    possible with the rounds before it."""
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


def _card(info: RoundInfo, frame: int, size: tuple[int, int]) -> Card:
    contents = Contents(Steps.open(info.path, (*TOPICS, ANNOTATIONS)))
    step = contents.steps[frame]
    image = np.empty((*size, 3), np.uint8)
    decode_into(step.image, image)
    big = cv2.resize(image, None, fx=SCALE, fy=SCALE, interpolation=cv2.INTER_LINEAR)
    for line in contents.markings(frame):
        points = np.round(line * SCALE - 0.5).astype(np.int32)  # OpenCV's pixel centres
        cv2.polylines(big, [points], False, _GREEN, 1, cv2.LINE_AA)
    lanes = counted(info.lanes, "lane")
    about = f"{info.id} #{frame} ({info.split or 'no side'}): {info.track}, {lanes}, {step.light}"
    return Card(np.asarray(big, np.uint8), about, contents.caption(frame))
