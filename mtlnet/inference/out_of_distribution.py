"""Defines when an image is out of distribution, that is, unlike the training images.

The uncertainty head of a model computes a score for each image (`mtlnet.model.uncertainty_head`); a
fit scales it so that the limit is 1 (`mtlnet.uncertainty_fit.ood`). An image of a camera whose
height makes lanes look wider or narrower than in training is out of distribution too.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

LIMIT = 1.0
"""Largest score of an image that is like the training images."""
COMMON_LANE_M = 3.6
SEEN_LANES_M = (2.75, 4.4)
"""Range of lane widths in training, m at the model's camera. A camera is out of distribution if its
height makes a lane of `COMMON_LANE_M` look wider or narrower than this range."""
HEIGHT_SCORE = 2.0
"""Minimum score of an image of a camera that is too high or too low."""


def is_out_of_distribution(score: NDArray[np.floating[Any]]) -> NDArray[np.bool_]:
    """Return whether images with the out-of-distribution scores `score` (...) are out of
    distribution (...). NaN, the score of a broken model, counts as out of distribution."""
    return ~(score <= LIMIT)


def is_height_seen(scale: float) -> bool:
    """Return whether lanes look as wide as in training to a camera at `scale` times the height of
    the model's camera."""
    narrowest, widest = SEEN_LANES_M
    return narrowest <= COMMON_LANE_M / scale <= widest
