"""Pictures of a film, a stream or a recording, and how they are fitted to the model's camera."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import cv2
import numpy as np
from numpy.typing import NDArray

from mtlnet.inference.image_decoding.decode import crop_and_resize
from mtlnet.inference.rectification import Rectification
from trackfeatures.camera import CameraParameters

Image = NDArray[np.uint8]
Lens = Rectification | float | None
"""Camera of pictures: a rectification from it, its vertical field of view in degrees, or None for
the model's camera."""


@dataclass(frozen=True, slots=True)
class Picture:
    """One picture, or the reason why it cannot be used; later pictures are not affected."""

    number: int
    """Number in its source, from 0."""
    image: Image | None
    """Pixels uint8 (H, W, 3), RGB, or BGR as film decoders return it."""
    time_s: float | None = None
    """Time, s: since the start of a film, else since 1970. None: unknown."""
    bgr: bool = False
    error: str = ""


@runtime_checkable
class LensFinder(Protocol):
    """Finds the camera of a stream while it runs."""

    def at(self, picture: Picture) -> Lens:
        """The lens for this picture, the next one in order; None until it is known."""


class Pictures(Protocol):
    """A source of pictures. `fault`, set after the last picture, is a text about the source's
    fault; empty if it has none."""

    fault: str

    def pictures(self) -> Iterator[Picture]:
        """Yields the pictures. Raises UserError or OSError where the source cannot be read."""


def fit(picture: Picture, camera: CameraParameters, lens: Lens) -> Image:
    """The picture fitted to the model's camera: uint8 RGB (camera.height, camera.width, 3).

    The order of the colours is converted last, when the picture is small. Raises ImageError.
    """
    assert picture.image is not None
    if isinstance(lens, Rectification):
        small = lens.image(picture.image)
    else:
        small = crop_and_resize(picture.image, camera, lens)
    if not picture.bgr:
        return small
    return cv2.cvtColor(small, cv2.COLOR_BGR2RGB).astype(np.uint8, copy=False)


def other_size(name: str, number: int, size: tuple[int, int], first: tuple[int, int]) -> str:
    """Fault text for a source whose picture `number` has another size (width, height) than the
    `first`: another camera, crop or mode took it."""
    return (
        f"{name}: picture {number} is {size[0]} x {size[1]} px, those before it are {first[0]} x "
        f"{first[1]} px and were used; give the rest by itself, with a camera of its own"
    )
