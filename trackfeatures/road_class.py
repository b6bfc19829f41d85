"""Defines the class of the road, the direction in which the road ahead bends, and the rule that
determines it from curvatures."""

from enum import IntEnum
from typing import Final

BEND_CURVATURE: Final = 1.0 / 170.0
"""Smallest curvature of a bend in 1/m; a road of lower curvature counts as straight."""
LOOK_AHEAD_M: Final = 20.0
"""If the road is straight at the car, its curvature this far ahead decides the class."""


class RoadClass(IntEnum):
    """The direction in which the road ahead bends: the third task of the network of Li et al. (see
    `definitions`), who call it the heading. Files, messages and answers use the name `heading`."""

    LEFT = 0
    STRAIGHT = 1
    RIGHT = 2


UNKNOWN_HEADING: Final = -1
"""Value of an unlabelled class; the loss and the metrics ignore it."""


def classify_heading(curvature: float, curvature_ahead: float) -> RoadClass:
    """Return the class of the road from the `curvature` at the car and the `curvature_ahead`, 20 m
    ahead of the car (1/m, left positive)."""
    for kappa in (curvature, curvature_ahead):
        if abs(kappa) >= BEND_CURVATURE:
            return RoadClass.LEFT if kappa > 0 else RoadClass.RIGHT
    return RoadClass.STRAIGHT
