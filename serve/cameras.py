"""The named cameras of a service (`serve --camera NAME=FILE`).

A request names a camera; the service never opens a file whose name a client sent.
"""

import re
from collections.abc import Iterable, Mapping
from pathlib import Path

from mtlnet.inference.image_decoding.errors import ImageError
from mtlnet.inference.rectification import Rectification
from runtime.camera_file import read_camera
from trackfeatures.camera import CameraParameters
from trackfeatures.errors import UserError

Cameras = Mapping[str, CameraParameters]
NO_CAMERAS: Cameras = {}
MAX_CAMERAS = 64


def read_cameras(options: Iterable[str], model: CameraParameters) -> dict[str, CameraParameters]:
    """Read the cameras of the options `NAME=FILE`, by name. Values that a file omits come from the
    model's camera `model`.

    Raises UserError for a faulty option or file, and for a camera whose images do not cover the
    view of the model's camera.
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
