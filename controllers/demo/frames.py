"""Chooses held-out frames from the demo's test rounds, and gets the service's answers to them."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from datagen.recording import Frames
from serve.client import Client
from trackfeatures import MARKINGS, RoadClass, localise


@dataclass(frozen=True, slots=True)
class PostedFrame:
    """One held-out frame (JPEG), its labels, and the answer of the service to this frame.

    The distances and the offset are in m, the angle in rad, the curvature in 1/m.
    """

    jpeg: bytes
    round_id: str
    track: str
    lanes: int
    distances: dict[str, float | None]
    to_lane_centre: float | None
    angle: float
    heading: str
    curvature: float
    answer: dict[str, Any]

    @property
    def answered_heading(self) -> str:
        classes: dict[str, float] = self.answer["heading"]
        return max(classes, key=lambda name: classes[name])


def spread(frames: Frames, count: int, rng: np.random.Generator) -> list[int]:
    """Return the indices of `count` random frames in ascending order, an equal share from each
    round.

    The result is shorter if a round has fewer frames than its share.
    """
    rounds = frames.labels.round
    shares = np.array_split(np.arange(count), len(np.unique(rounds)))
    chosen: list[int] = []
    for number, share in zip(np.unique(rounds), shares, strict=True):
        here = np.flatnonzero(rounds == number)
        chosen += rng.choice(here, size=min(len(share), len(here)), replace=False).tolist()
    return sorted(chosen)


def post_frames(frames: Frames, indices: list[int], client: Client) -> list[PostedFrame]:
    """Post the recorded JPEG images of the frames with the given `indices` to the service. Returns
    the answers together with the labels of the frames."""
    return [_post_frame(frames, index, client) for index in indices]


def _post_frame(frames: Frames, index: int, client: Client) -> PostedFrame:
    labels = frames.labels
    jpeg = bytes(frames.jpeg(index))
    answer = client.features(jpeg)
    values = labels.distances[index]
    about = frames.rounds[int(labels.round[index])]
    return PostedFrame(
        jpeg=jpeg,
        round_id=about.id,
        track=about.track,
        lanes=about.lanes,
        distances={
            name: None if np.isnan(value) else float(value)
            for name, value in zip(MARKINGS, values, strict=True)
        },
        to_lane_centre=_lane_offset(values),
        angle=float(labels.angle[index]),
        heading=RoadClass(int(labels.heading[index])).name.lower(),
        curvature=float(labels.curvature[index]),
        answer=answer,
    )


def _lane_offset(values: Any) -> float | None:
    centre = float(localise(values)[0])
    return None if np.isnan(centre) else centre
