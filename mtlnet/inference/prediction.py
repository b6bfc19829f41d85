"""Decoding a model's outputs into track features, in metres and radians.

Units and signs are those of `trackfeatures`: distances are negative to the left, the lateral offset
is positive to the left, the angle is positive when the car points to the right of the track.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

import trackfeatures as tf
from mtlnet.inference.uncertainty import COLUMNS, FEATURES

OUTPUTS = 9  # five coded distances, the coded angle, three class probabilities
WITH_UNCERTAINTY = OUTPUTS + COLUMNS  # and the columns of `mtlnet.inference.uncertainty`


@dataclass(frozen=True, slots=True)
class Prediction:
    """Track features predicted from one image.

    `std` and `out_of_distribution` are None for a model without an uncertainty head.
    """

    distances_m: dict[str, float | None]
    """By marking; None where the marking is absent."""
    to_lane_centre_m: float | None
    """Left positive; None where no marking is near."""
    angle_rad: float
    heading: dict[str, float]
    """Probability of each class."""
    std: dict[str, float | None] | None = None
    """Standard deviation of the error of each of `mtlnet.inference.uncertainty.FEATURES`, m or rad;
    None for an absent feature."""
    out_of_distribution: bool | None = None
    """Whether the image differs from the training images more than those from each other."""

    def as_json(self) -> dict[str, Any]:
        """The prediction as the service returns it (DESIGN §9)."""
        return {
            "distances_m": dict(self.distances_m),
            "to_lane_centre_m": self.to_lane_centre_m,
            "angle_rad": self.angle_rad,
            "heading": dict(self.heading),
            "std": None if self.std is None else dict(self.std),
            "out_of_distribution": self.out_of_distribution,
        }


def decode_outputs(outputs: NDArray[np.float32]) -> Prediction:
    """Decode one image's outputs, of shape (`OUTPUTS`,) or (`WITH_UNCERTAINTY`,)."""
    if outputs.shape not in ((OUTPUTS,), (WITH_UNCERTAINTY,)):
        raise ValueError(
            f"a model gives {OUTPUTS} or {WITH_UNCERTAINTY} numbers an image, "
            f"not shape {outputs.shape}"
        )
    coded, probabilities, uncertainty = outputs[:6], outputs[6:OUTPUTS], outputs[OUTPUTS:]
    distances, angle = tf.decode(coded[None])
    decoded = [*distances[0], tf.localise(distances)[0]]
    values = [None if np.isnan(value) else float(value) for value in decoded]
    std = None
    if len(uncertainty):
        present = [value is not None for value in values] + [True]  # the angle is never absent
        columns = zip(FEATURES, uncertainty[:-1].tolist(), present, strict=True)
        std = {name: value if found else None for name, value, found in columns}
    return Prediction(
        distances_m=dict(zip(tf.MARKINGS, values[:5], strict=True)),
        to_lane_centre_m=values[5],
        angle_rad=float(angle[0]),
        heading={
            name.name.lower(): float(p) for name, p in zip(tf.Heading, probabilities, strict=True)
        },
        std=std,
        # Written so that a NaN counts as out of distribution too.
        out_of_distribution=not uncertainty[-1] <= 1.0 if len(uncertainty) else None,
    )
