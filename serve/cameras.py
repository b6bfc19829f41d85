"""The named cameras of a service (`serve --camera NAME=FILE`), and the mapping of an image to the
view of the model's camera.

A request names a camera; the service never opens a file whose name a client sent.
"""

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mtlnet.inference.image_decoding.crop import crop_box
from mtlnet.inference.image_decoding.decode import crop_and_resize
from mtlnet.inference.image_decoding.errors import ImageError
from mtlnet.inference.rectification import Rectification
from runtime.camera_file import read_camera
from trackfeatures.camera import CameraParameters
from trackfeatures.errors import UserError

Cameras = Mapping[str, CameraParameters]
MAX_CAMERAS = 64


def read_cameras(options: Iterable[str], model: CameraParameters) -> dict[str, CameraParameters]:
    """The cameras of `NAME=FILE` options; values that a file omits come from the model's camera.

    Raises UserError for a faulty option or file, and for a camera that sees too little.
    """
    found: dict[str, CameraParameters] = {}
    for option in options:
        name, equals, file = option.partition("=")
        if not (equals and file and re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9._-]{0,63}", name)):
            raise UserError(
                f"--camera is {option!r}; give NAME=FILE, with a name of up to 64 letters, digits, "
                "points, dashes and underscores, for example --camera roof=roof.yaml"
            )
        if name in found:
            raise UserError(f"--camera gives {name} twice; give each camera a name of its own")
        found[name] = read_camera(Path(file), model)
        try:
            Rectification(found[name], model).check(found[name].width, found[name].height)
        except ImageError as error:
            raise UserError(f"{file}: with this camera {error}") from error
    if len(found) > MAX_CAMERAS:
        raise UserError(f"--camera is given {len(found)} times; give at most {MAX_CAMERAS}")
    return found


@dataclass(frozen=True, slots=True)
class Sight:
    """The camera of an image: `camera`, if given; else the model's camera, with the vertical field
    of view `fov_y_deg` if given."""

    fov_y_deg: float | None = None
    camera: CameraParameters | None = None

    def check(self, width: int, height: int, view: CameraParameters) -> None:
        """Raise ImageError if an image of this size in px does not cover what `view` shows."""
        if self.camera is None:
            crop_box(width, height, view, self.fov_y_deg)
        else:
            Rectification(self.camera, view).check(width, height)

    def through(self, image: NDArray[np.uint8], view: CameraParameters) -> NDArray[np.uint8]:
        """`image` (H, W, 3) as seen by the model's camera `view`. Raises ImageError."""
        if self.camera is None:
            return crop_and_resize(image, view, self.fov_y_deg)
        return Rectification(self.camera, view).image(image)

    def crop_px(self, width: int, height: int, view: CameraParameters) -> list[int] | None:
        """[left, top, width, height] in px of the part that the model sees. None if the whole image
        is used or the image is warped."""
        box = None if self.camera else crop_box(width, height, view, self.fov_y_deg)
        return None if box is None else [box.left, box.top, box.width, box.height]
