"""Kinds of image of a view: colour, or the depth or class of each pixel."""

from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from simulator.camera.core.optics import FAR_M, VIEWS
from trackfeatures.errors import UserError

CLASSES: tuple[str, ...] = ("road", "marking", "car", "ground", "sky", "object")
"""Classes of a pixel; the index is the class number. `object`: trees, rails, houses, signs and
all else beside the road; `ground`: kerb, verge, terrain; worn-off paint is `road`."""

COLOUR, DEPTH, CLASS = PICTURE_KINDS = ("colour", "depth", "class")


@dataclass(frozen=True)
class ViewRequest:
    """A requested image: view and kind."""

    view: str
    kind: str = COLOUR

    @classmethod
    def of(cls, name: str) -> Self:
        """Read "front", "front:depth" or "front:class"; UserError for an unknown view or kind."""
        view, _, kind = name.partition(":")
        if view not in VIEWS:
            raise UserError(
                f"unknown camera view '{view}' in '{name}'; the views are {', '.join(VIEWS)}"
            )
        if (kind or COLOUR) not in PICTURE_KINDS or name.endswith(":"):
            raise UserError(
                f"unknown kind of picture '{kind}' in '{name}'; "
                f"the kinds are {', '.join(PICTURE_KINDS)}"
            )
        return cls(view, kind or COLOUR)


def bounded(picture: NDArray[Any]) -> NDArray[Any]:
    """`picture`; in a depth image the depth of the sky is changed from infinity to FAR_M."""
    return np.minimum(picture, FAR_M, out=picture) if picture.dtype == np.float32 else picture
