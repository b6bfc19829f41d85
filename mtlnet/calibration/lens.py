"""Finds the lens of a camera before its mount is estimated. The lens is given by the user, read
from the EXIF of a photo, or guessed."""

from dataclasses import dataclass, replace
from math import atan, degrees, hypot, radians, tan
from pathlib import Path

from mtlnet.inference.image_decoding.decode import read_whole_image
from mtlnet.inference.image_decoding.orientation import EXIF_MARK, read_tags
from trackfeatures.camera import CameraError, CameraParameters
from trackfeatures.errors import UserError

GUESSED_FOV_DEG = 65.0
"""Guessed field of view along the longer side, degrees. In a film it is 55 to 70 degrees for a
phone's main lens, and at least 70 degrees for a dash camera."""
GUESSED_STD, PHOTO_STD = 0.2, 0.05
"""Relative standard deviations of a guessed focal length, and of the focal length in a photo's
EXIF. Phones crop their films a little, so the film's focal length differs from the photo's."""
FILM_DIAGONAL_MM = 43.27
"""Diagonal of 36 x 24 mm film, the reference of EXIF's 35 mm focal length (CIPA DC-008)."""
EXIF_DIRECTORY, FOCAL_35MM = 0x8769, 0xA405
HEAD_BYTES = 1 << 17


@dataclass(frozen=True)
class KnownLens:
    """A camera with the size and lens of its pictures. `std`: relative standard deviation of the
    focal length; `about`: a text that names the source of the lens."""

    camera: CameraParameters
    std: float
    about: str


def find_lens(
    size: tuple[int, int],
    model: CameraParameters,
    given: CameraParameters | None = None,
    fov_y_deg: float | None = None,
    photo: Path | None = None,
) -> KnownLens:
    """Return the lens of pictures of `size` (width, height), px.

    It is taken from the first of these that is not None: the camera `given`, the vertical field of
    view `fov_y_deg`, the EXIF of `photo`. If all are None, a field of view of 65 degrees along the
    longer side is assumed. The camera's position on the car is the position of `given`, else of
    `model`. Raises UserError if the source does not fit the pictures or states no focal length.
    """
    width, height = size
    if given is not None:
        if abs(given.width * height - given.height * width) > 0.01 * given.width * height:
            raise UserError(
                f"the pictures are {width} x {height} px, the camera file is for "
                f"{given.width} x {given.height} px: give the file of this camera"
            )
        return KnownLens(given.resized(width, height), 0.0, "its lens is given")
    plain = CameraParameters(width, height, x=model.x, y=model.y)
    if fov_y_deg is not None:
        try:
            found = replace(plain, fov_y_deg=fov_y_deg)
        except CameraError as error:
            raise UserError(f"--fov-y-deg: {error}") from error
        return KnownLens(found, 0.0, f"field of view {fov_y_deg:g} deg, given")
    if photo is not None:
        focal_px = photo_focal_share(photo) * max(size)
        fov = degrees(2 * atan(height / 2 / focal_px))
        return KnownLens(
            replace(plain, fov_y_deg=fov), PHOTO_STD, f"field of view {fov:.1f} deg, EXIF"
        )
    focal_px = max(size) / 2 / tan(radians(GUESSED_FOV_DEG) / 2)
    fov = degrees(2 * atan(height / 2 / focal_px))
    about = f"field of view {fov:.1f} deg, guessed: give --fov-y-deg"
    return KnownLens(replace(plain, fov_y_deg=fov), GUESSED_STD, about)


def photo_focal_share(path: Path) -> float:
    """Read the focal length of a JPEG photo from its EXIF, relative to the picture's longer side.
    Raises UserError if there is none."""
    picture = read_whole_image(path)
    with path.open("rb") as file:
        head = file.read(HEAD_BYTES)
    at = head.find(EXIF_MARK)
    block = head[at + len(EXIF_MARK) :] if at >= 0 else b""
    _, offset = read_tags(block).get(EXIF_DIRECTORY, (0, -1))
    focal_mm = 0
    if offset >= 0:
        little = block.startswith(b"II")
        moved = block[:4] + offset.to_bytes(4, "little" if little else "big") + block[8:]
        _, focal_mm = read_tags(moved).get(FOCAL_35MM, (0, 0))
    if focal_mm <= 0:
        raise UserError(
            f"{path} states no focal length (EXIF FocalLengthIn35mmFilm); give --fov-y-deg"
        )
    height, width = picture.shape[:2]
    return float(focal_mm / FILM_DIAGONAL_MM * hypot(width, height) / max(width, height))
