"""What the network says about one image, in metres and radians. Free of torch: the service uses it.

Units and signs are those of `trackfeatures`: left negative for distances, left positive for the
lateral offset, the angle positive when the car points to the right of the track.
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
    """Track features read from one image.

    Distances in m, None where the marking is absent; `to_lane_centre_m` in m, left positive, None
    where no marking is near; the angle in rad; `heading` the probability of each class. `std`: the
    standard deviation of the error of each of `mtlnet.inference.uncertainty.FEATURES` in m and rad,
    None for what is absent. `out_of_distribution`: the image is unlike those the model learned
    from. Both are None where the model was published without frames to learn them from.
    """

    distances_m: dict[str, float | None]
    to_lane_centre_m: float | None
    angle_rad: float
    heading: dict[str, float]
    std: dict[str, float | None] | None = None
    out_of_distribution: bool | None = None

    def as_json(self) -> dict[str, Any]:
        """The answer as the service gives it (DESIGN §9)."""
        return {
            "distances_m": dict(self.distances_m),
            "to_lane_centre_m": self.to_lane_centre_m,
            "angle_rad": self.angle_rad,
            "heading": dict(self.heading),
            "std": None if self.std is None else dict(self.std),
            "out_of_distribution": self.out_of_distribution,
        }


def decode_outputs(outputs: NDArray[np.float32]) -> Prediction:
    """The prediction in a model's outputs: `OUTPUTS` of them, or `WITH_UNCERTAINTY`."""
    if outputs.shape not in ((OUTPUTS,), (WITH_UNCERTAINTY,)):
        raise ValueError(
            f"a model gives {OUTPUTS} or {WITH_UNCERTAINTY} numbers an image, "
            f"not shape {outputs.shape}"
        )
    coded, probabilities, uncertainty = outputs[:6], outputs[6:OUTPUTS], outputs[OUTPUTS:]
    distances, angle = tf.decode(coded[None])
    found = [*distances[0], tf.localise(distances)[0]]
    values = [None if np.isnan(value) else float(value) for value in found]
    std = None
    if len(uncertainty):
        here = [value is not None for value in values] + [True]  # the angle is never absent
        stated = zip(FEATURES, uncertainty[:-1].tolist(), here, strict=True)
        std = {name: value if present else None for name, value, present in stated}
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
