"""Pictures of a film, stream or recording, and their conversion to the view of the model's
camera."""

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
"""Camera of pictures: a rectification from this camera to the model's, the vertical field of view
in degrees, or None for the model's camera."""


@dataclass(frozen=True, slots=True)
class Picture:
    """One picture, or the reason why it cannot be used (`error`). An error does not affect later
    pictures."""

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
    """Interface of an object that finds the camera of a stream while its pictures arrive."""

    def at(self, picture: Picture) -> Lens:
        """Return the lens for `picture`: the lens of the camera that was found or, as long as no
        camera was found, an assumed lens. Must be called for each picture in order."""


class Pictures(Protocol):
    """Interface of a source of pictures. `fault`, set after the last picture, describes the
    source's fault; empty if it has none."""

    fault: str

    def pictures(self) -> Iterator[Picture]:
        """Yields the pictures. Raises UserError or OSError where the source cannot be read."""


def fit(picture: Picture, camera: CameraParameters, lens: Lens) -> Image:
    """Convert a picture to the view of the model's `camera`: uint8 RGB
    (camera.height, camera.width, 3).

    `lens`: the camera that took the picture. Colours are converted from BGR last, when the picture
    is small. Raises ImageError when the picture does not show enough of this view.
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
    """Return the fault of a source whose picture `number` has another size (width, height), px,
    than its `first` picture, because another camera, crop or mode took it."""
    return (
        f"{name}: picture {number} is {size[0]} x {size[1]} px, those before it are {first[0]} x "
        f"{first[1]} px and were used; give the rest by itself, with a camera of its own"
    )
