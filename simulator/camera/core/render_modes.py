"""Kinds of image of a view: colour, depth of each pixel, or class of each pixel."""

from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from simulator.camera.core.optics import FAR_M, VIEWS
from trackfeatures.errors import UserError

CLASSES: tuple[str, ...] = ("road", "marking", "car", "ground", "sky", "object")
"""Classes of a pixel; the index in this tuple is the class number. `object` is everything beside
the road that has no other class, such as trees, rails, houses and signs. `ground` is kerb, verge
and terrain. Worn-off paint is `road`."""

COLOUR, DEPTH, CLASS = PICTURE_KINDS = ("colour", "depth", "class")


@dataclass(frozen=True)
class ViewRequest:
    """A requested image: name of the view (one of VIEWS) and kind (one of PICTURE_KINDS)."""

    view: str
    kind: str = COLOUR

    @classmethod
    def of(cls, name: str) -> Self:
        """Parse "front", "front:depth" or "front:class". Raises UserError if the name is
        unknown."""
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
    """Replace infinite depth (the sky) by FAR_M (6000 m) if `picture` is a depth image (float32),
    and return the same array. Other images are returned unchanged."""
    return np.minimum(picture, FAR_M, out=picture) if picture.dtype == np.float32 else picture
