"""Finds the part of an image that shows the field of view of the model's camera (pinhole, centred).

A model is trained with one camera. A stretched image, or an image with another field of view, would
give wrong distances and angles without any error message. So a wider image is cropped to the
camera's field of view, and a narrower image is refused.
"""

from dataclasses import dataclass
from math import radians, tan

from mtlnet.inference.image_decoding.errors import Fault, ImageError
from trackfeatures.camera import CameraParameters

TOLERANCE = 0.01  # of width and height, for rounding to whole pixels and small calibration errors


@dataclass(frozen=True, slots=True)
class Box:
    """A rectangle of an image, px; `left` and `top` are its first column and row."""

    left: int
    top: int
    width: int
    height: int


def crop_box(
    width: int, height: int, view: CameraParameters, fov_y_deg: float | None = None
) -> Box | None:
    """Return the part of an image of `width` x `height` px that the camera `view` shows; None if it
    is the whole image.

    `fov_y_deg`: vertical field of view of the image, degrees; None: the field of view of `view`. A
    pinhole camera of focal length f px shows 2 f tan(fov/2) px. Raises ImageError when the image
    shows less than `view`.
    """
    ratio = 1.0
    if fov_y_deg is not None:
        ratio = tan(radians(view.fov_y_deg) / 2) / tan(radians(fov_y_deg) / 2)
    rows = height * ratio
    columns = rows * view.width / view.height
    if rows > height * (1 + TOLERANCE) or columns > width * (1 + TOLERANCE):
        raise _too_narrow(width, height, view, fov_y_deg)
    if rows >= height * (1 - TOLERANCE) and columns >= width * (1 - TOLERANCE):
        return None
    kept_columns, kept_rows = min(round(columns), width), min(round(rows), height)
    if min(kept_columns, kept_rows) < 1:
        raise _too_narrow(width, height, view, fov_y_deg)
    return Box((width - kept_columns) // 2, (height - kept_rows) // 2, kept_columns, kept_rows)


def _too_narrow(
    width: int, height: int, view: CameraParameters, fov_y_deg: float | None
) -> ImageError:
    shape = f"{view.width} x {view.height} ({view.width / view.height:.3f})"
    if fov_y_deg is None:
        return ImageError(
            Fault.ASPECT,
            f"the image is {width} x {height} px (width / height {width / height:.3f}), the "
            f"model's camera gives {shape}; a wider image is cropped to it, a narrower one cannot "
            "be: give the whole image of such a camera, at any size",
        )
    return ImageError(
        Fault.FIELD_OF_VIEW,
        f"the image is {width} x {height} px with a vertical field of view of {fov_y_deg:g} "
        f"degrees, the model's camera gives {shape} with {view.fov_y_deg:g}: such an image does "
        "not show all that the model needs; use a wider lens",
    )
