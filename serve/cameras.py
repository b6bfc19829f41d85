"""The cameras that a service knows by name, `serve --camera NAME=FILE`, and how an image is seen.

A request names one; the service opens no file that a client names.
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
    """The cameras of `NAME=FILE` options; what a file leaves out is as in the model's camera.

    Raises UserError.
    """
    found: dict[str, CameraParameters] = {}
    for option in options:
        name, equals, file = option.partition("=")
        if not (equals and file and re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9._-]{0,63}", name)):
            raise UserError(
                f"--camera is {option!r}; give NAME=FILE, with a name of up to 64 letters, digits, "
                "points, dashes and underscores, as --camera roof=roof.yaml"
            )
        if name in found:
            raise UserError(f"--camera gives {name} twice; give each camera a name of its own")
        found[name] = read_camera(Path(file), model)
        try:
            Rectification(found[name], model).check(found[name].width, found[name].height)
        except ImageError as error:
            raise UserError(f"{file}: of this camera {error}") from error
    if len(found) > MAX_CAMERAS:
        raise UserError(f"--camera is given {len(found)} times; at most {MAX_CAMERAS} are kept")
    return found


@dataclass(frozen=True, slots=True)
class Sight:
    """What is known of the camera of an image: `camera`, else its vertical field of view
    `fov_y_deg`, else it is the model's."""

    fov_y_deg: float | None = None
    camera: CameraParameters | None = None

    def check(self, width: int, height: int, view: CameraParameters) -> None:
        """Raise ImageError where an image of that size does not show what `view` does."""
        if self.camera is None:
            crop_box(width, height, view, self.fov_y_deg)
        else:
            Rectification(self.camera, view).check(width, height)

    def through(self, image: NDArray[np.uint8], view: CameraParameters) -> NDArray[np.uint8]:
        """An image (H, W, 3) as the model's camera `view` sees it. Raises ImageError."""
        if self.camera is None:
            return crop_and_resize(image, view, self.fov_y_deg)
        return Rectification(self.camera, view).image(image)

    def crop_px(self, width: int, height: int, view: CameraParameters) -> list[int] | None:
        """[left, top, width, height] of the part the model sees, px; None: the whole image, or one
        that is warped."""
        box = None if self.camera else crop_box(width, height, view, self.fov_y_deg)
        return None if box is None else [box.left, box.top, box.width, box.height]
