"""Pictures of a film, a stream or a recording, as they were taken, and how they reach the model."""

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
"""Of pictures: their camera, or its vertical field of view in degrees; None: the model's."""


@dataclass(frozen=True, slots=True)
class Picture:
    """One picture, or why it cannot be used: the others are not lost."""

    number: int
    """Within its source, from 0."""
    image: Image | None
    """uint8 (H, W, 3), RGB or, as decoders of films give it, BGR."""
    time_s: float | None = None
    """Since 1970; of a film since its start. None: unknown."""
    bgr: bool = False
    error: str = ""


@runtime_checkable
class LensFinder(Protocol):
    """Finds the camera of a stream while it runs."""

    def at(self, picture: Picture) -> Lens:
        """The lens for this picture, which is the next one: None until it is known."""


class Pictures(Protocol):
    """A source of pictures. `fault` is known after the last one: what is wrong, empty where nothing
    is."""

    fault: str

    def pictures(self) -> Iterator[Picture]:
        """Raises UserError or OSError where the source cannot be read."""


def fit(picture: Picture, camera: CameraParameters, lens: Lens) -> Image:
    """The picture as the model takes it: uint8 RGB (camera.height, camera.width, 3).

    Colours are put in order last, when the picture is small. Raises ImageError.
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
    """The fault of a source whose picture `number` has another size (width, height) than the
    `first`: another camera, crop or mode took it."""
    return (
        f"{name}: picture {number} is {size[0]} x {size[1]} px, those before it are {first[0]} x "
        f"{first[1]} px and were used; give the rest by itself, with a camera of its own"
    )
