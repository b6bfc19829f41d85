"""What the network says about one image, in metres and radians. Free of torch: the service uses it.

Units and signs are those of `trackfeatures`: left negative for distances, left positive for the
lateral offset, the angle positive when the car points to the right of the track.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

import trackfeatures as tf

OUTPUTS = 9  # five coded distances, the coded angle, three class probabilities


@dataclass(frozen=True, slots=True)
class Answer:
    """Track features read from one image.

    Distances in m, None where the marking is absent; `to_lane_centre_m` in m, left positive, None
    where no marking is near; the angle in rad; `heading` the probability of each class.
    """

    distances_m: dict[str, float | None]
    to_lane_centre_m: float | None
    angle_rad: float
    heading: dict[str, float]

    def as_json(self) -> dict[str, Any]:
        """The answer as the service gives it (DESIGN §9)."""
        return {
            "distances_m": dict(self.distances_m),
            "to_lane_centre_m": self.to_lane_centre_m,
            "angle_rad": self.angle_rad,
            "heading": dict(self.heading),
        }


def interpret(outputs: NDArray[np.float32]) -> Answer:
    """The answer in the network's outputs (9,): see `OUTPUTS` for their order."""
    if outputs.shape != (OUTPUTS,):
        raise ValueError(f"the network gives {OUTPUTS} numbers an image, not shape {outputs.shape}")
    distances, angle = tf.decode(outputs[None, :6])
    offset = float(tf.localise(distances)[0])
    return Answer(
        distances_m={
            name: None if np.isnan(value) else float(value)
            for name, value in zip(tf.MARKINGS, distances[0], strict=True)
        },
        to_lane_centre_m=None if np.isnan(offset) else offset,
        angle_rad=float(angle[0]),
        heading={
            name.name.lower(): float(p) for name, p in zip(tf.Heading, outputs[6:], strict=True)
        },
    )
