"""The frames on which a model errs most, with true and answered markings drawn on them."""

import base64
from collections.abc import Iterator
from dataclasses import dataclass
from html import escape

import numpy as np
import simplejpeg
from numpy.typing import NDArray

import trackfeatures as tf
from datagen.recording import Frames
from mtlnet.answer import Answer, interpret
from mtlnet.card import CENTRE_HEIGHT_M
from mtlnet.doubt import FEATURES
from mtlnet.errors import Numbers
from mtlnet.picture import draw_answer

EACH = 2
"""Frames of each feature..."""
APART = 40
"""...which in the same round lie at least so many frames apart: one bad place is shown once."""
QUALITY = 80


@dataclass(frozen=True)
class Worst:
    """Frame `row`, on which `feature` is `error` (m or rad, signed) off."""

    row: int
    feature: str
    error: float


def worst_frames(errors: Numbers, rounds: NDArray[np.int64]) -> list[Worst]:
    """The `EACH` worst frames of each feature, errors (N, 7); no place is shown twice."""
    chosen: list[Worst] = []
    for i in (5, 6, 0, 1, 3, 2, 4):
        sizes = np.abs(errors[:, i])
        order = np.argsort(-np.nan_to_num(sizes, nan=-1.0), kind="stable")
        found = 0
        for row in order.tolist():
            if found == EACH or np.isnan(sizes[row]):
                break
            if all(abs(row - w.row) >= APART or rounds[row] != rounds[w.row] for w in chosen):
                chosen.append(Worst(row, FEATURES[i], float(errors[row, i])))
                found += 1
    return chosen


def figures(frames: Frames, outputs: NDArray[np.float32], chosen: list[Worst]) -> Iterator[str]:
    """The chosen frames as HTML figures: truth green, answer orange."""
    labels, camera = frames.labels, frames.camera
    for one in chosen:
        answer = interpret(outputs[one.row])
        truth = [None if np.isnan(d) else float(d) for d in labels.distances[one.row]]
        image = draw_answer(
            frames.image(one.row),
            camera,
            camera.z + CENTRE_HEIGHT_M,
            float(labels.curvature[one.row]),
            (dict(zip(tf.MARKINGS, truth, strict=True)), float(labels.angle[one.row])),
            (answer.distances_m, answer.angle_rad),
        )
        jpeg = simplejpeg.encode_jpeg(np.ascontiguousarray(image), quality=QUALITY)
        yield (
            f'<figure><img src="data:image/jpeg;base64,{base64.b64encode(jpeg).decode()}" '
            f'alt="{one.feature}"><figcaption>{_caption(frames, one, answer)}</figcaption></figure>'
        )


def _caption(frames: Frames, one: Worst, answer: Answer) -> str:
    labels = frames.labels
    info = frames.rounds[int(labels.round[one.row])]
    unit = "rad" if one.feature == "angle" else "m"
    said = None if answer.std is None else answer.std[one.feature]
    doubt = "" if said is None else f", said to be known to {said:.2g} {unit}"
    strange = ", called out of distribution" if answer.out_of_distribution else ""
    place = f"{info.id}, {info.track}, s = {labels.s[one.row]:.0f} m"
    about = f"{info.lanes} lane(s), {labels.light[one.row]}, {labels.speed[one.row] * 3.6:.0f} km/h"
    return (
        f"<b>{one.feature} {one.error:+.2g} {unit}</b>{doubt}{strange}"
        f"<br><small>{escape(place)}; {escape(about)}</small>"
    )
