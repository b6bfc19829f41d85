"""Decodes a model's outputs to track features, in metres and radians.

Units and signs are defined in `trackfeatures`: distances are negative to the left, the lateral
offset is positive to the left, the angle is positive when the car points to the right of the track.
"""

from dataclasses import dataclass
from math import isnan
from typing import Any

import numpy as np
from numpy.typing import NDArray

import trackfeatures as tf
from mtlnet.inference.out_of_distribution import is_out_of_distribution

FEATURES = (*tf.MARKINGS, "to_lane_centre", "angle")
"""Features that have a standard deviation; its unit is m, for the angle rad."""
COLUMNS = len(FEATURES) + 1
"""Number of columns of the uncertainty head: the standard deviations and the out-of-distribution
score."""
OUTPUTS = 9  # five coded distances, the coded angle, three class probabilities
MARKINGS = len(tf.MARKINGS)
ROAD_CLASSES = tuple(heading.name.lower() for heading in tf.RoadClass)
# Maps the number of columns of outputs to whether they have uncertainty and absence columns.
_HAS = {
    OUTPUTS + with_uncertainty * COLUMNS + with_absent * MARKINGS: (with_uncertainty, with_absent)
    for with_uncertainty in (False, True)
    for with_absent in (False, True)
}


@dataclass(frozen=True, slots=True)
class OutputParts:
    """Parts of a model's outputs; for the outputs of N images, each part has a first axis N."""

    coded: NDArray[np.float32]
    """Coded values (..., 6): five distances and the angle."""
    heading: NDArray[np.float32]
    """Probability of each class (..., 3)."""
    std: NDArray[np.float32] | None
    """Standard deviations (..., 7); None for a model without an uncertainty head."""
    ood_score: NDArray[np.float32] | None
    """Out-of-distribution score (...); an image with a score above 1 is out of distribution. None
    for a model without an uncertainty head."""
    absent: NDArray[np.float32] | None
    """Probability that each marking is absent (..., 5); None for heads of coded values."""


def split_outputs(outputs: NDArray[np.float32]) -> OutputParts:
    """Split outputs (..., K) into their parts.

    The first nine columns are five coded distances, the coded angle and three class probabilities.
    If the model has them, 8 columns of the uncertainty head and 5 probabilities of absence follow,
    so K is 9, 14, 17 or 22. `mtlnet.model.uncertainty_head` defines the uncertainty columns. Raises
    ValueError for another number of columns.
    """
    width = outputs.shape[-1] if outputs.ndim else 0
    if width not in _HAS:
        raise ValueError(
            f"a model gives {', '.join(map(str, sorted(_HAS)))} numbers for an image, "
            f"not shape {outputs.shape}"
        )
    with_uncertainty, with_absent = _HAS[width]
    end = OUTPUTS + COLUMNS
    return OutputParts(
        outputs[..., :6],
        outputs[..., 6:OUTPUTS],
        outputs[..., OUTPUTS : end - 1] if with_uncertainty else None,
        outputs[..., end - 1] if with_uncertainty else None,
        outputs[..., -MARKINGS:] if with_absent else None,
    )


@dataclass(frozen=True, slots=True)
class Prediction:
    """Track features predicted from one image.

    `std` and `out_of_distribution` are None for a model without an uncertainty head.
    """

    distances_m: dict[str, float | None]
    """Distance in m by marking; None if the marking is absent."""
    to_lane_centre_m: float | None
    """Offset from the lane's centre, m, positive to the left; None if all markings are absent."""
    angle_rad: float
    heading: dict[str, float]
    """Probability of each class of the road, by name."""
    std: dict[str, float | None] | None = None
    """Standard deviation of the error of each of `FEATURES`, m or rad;
    None for an absent feature."""
    out_of_distribution: bool | None = None
    """Whether the image is unlike the training images: its out-of-distribution score is above 1."""
    absent: dict[str, float] | None = None
    """Probability that each marking is absent; None for a model with heads of coded values."""

    @property
    def road_class(self) -> str:
        """The most probable class of the road ahead: left, straight or right."""
        return max(self.heading, key=self.heading.__getitem__)

    def as_json(self) -> dict[str, Any]:
        """Return the prediction as values for JSON, with the keys of the service's answer."""
        return {
            "distances_m": dict(self.distances_m),
            "to_lane_centre_m": self.to_lane_centre_m,
            "angle_rad": self.angle_rad,
            "heading": dict(self.heading),
            "std": None if self.std is None else dict(self.std),
            "out_of_distribution": self.out_of_distribution,
            "absent": None if self.absent is None else dict(self.absent),
        }


def decode_outputs(outputs: NDArray[np.float32]) -> Prediction:
    """Decode the outputs (K,) of one image to track features; `split_outputs` explains the K
    numbers.

    Raises ValueError for another shape.
    """
    if outputs.ndim != 1:
        raise ValueError(f"the outputs of one image have one axis, not shape {outputs.shape}")
    parts = split_outputs(outputs)
    distances, angle = tf.decode(parts.coded[None])
    decoded = [*distances[0].tolist(), *tf.localise(distances).tolist()]
    values = [None if isnan(value) else value for value in decoded]
    std = absent = foreign = None
    if parts.std is not None:
        present = [value is not None for value in values] + [True]  # the angle is never absent
        columns = zip(FEATURES, parts.std.tolist(), present, strict=True)
        std = {name: value if found else None for name, value, found in columns}
    if parts.ood_score is not None:
        foreign = bool(is_out_of_distribution(parts.ood_score))
    if parts.absent is not None:
        absent = dict(zip(tf.MARKINGS, parts.absent.tolist(), strict=True))
    return Prediction(
        distances_m=dict(zip(tf.MARKINGS, values[:5], strict=True)),
        to_lane_centre_m=values[5],
        angle_rad=float(angle[0]),
        heading=dict(zip(ROAD_CLASSES, parts.heading.tolist(), strict=True)),
        std=std,
        out_of_distribution=foreign,
        absent=absent,
    )
