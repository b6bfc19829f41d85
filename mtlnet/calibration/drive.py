"""`mtlnet calibrate drive.mp4`: estimates the camera of a film or of consecutive pictures of a
drive."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import chain
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from mtlnet.calibration.film import KEPT, DriveCalibration, DriveEstimate
from mtlnet.calibration.lens import KnownLens
from mtlnet.calibration.mount import NotCalibrated
from mtlnet.inference.image_decoding.decode import read_whole_image
from mtlnet.sources.films import Film, read_film_header
from trackfeatures.errors import UserError

LONGEST_S = 120.0
"""Maximum duration of a film that is read, s."""
DEFAULT_FPS = 25.0
PICTURE_S = 1.0
"""Assumed time (s) between consecutive pictures, whose times are unknown. It is too long to follow
points from one picture to the next."""
SHOWN = 6
"""Number of pictures kept for the page."""

Picture = NDArray[np.uint8]
MakeLens = Callable[[tuple[int, int]], KnownLens]
"""A function that returns the lens of pictures of a size (width, height), px."""
Report = Callable[[float, float], None]
"""A function that is called with what is done so far and the total, both in s of a film or in
numbers of pictures."""


@dataclass(frozen=True)
class CalibratedDrive:
    """The estimated camera, up to six of the pictures, a text about damage of the film, and a text
    about pictures that were not used; a text is empty if there is none of them."""

    found: DriveEstimate
    shown: list[Picture]
    fault: str = ""
    unused: str = ""


def calibrate_film(
    path: Path,
    make_lens: MakeLens,
    lane_width_m: float | None = None,
    report: Report = lambda done, total: None,
    longest_s: float = LONGEST_S,
) -> CalibratedDrive:
    """Estimate the camera of the film `path` from at most its first `longest_s` seconds.

    `make_lens(size)` returns the lens for pictures of `size` (width, height) px; `lane_width_m`:
    width of the lane driven in, None if unknown; `report(done_s, total_s)` is called for each
    picture. Raises NotCalibrated if too few pictures show a marked straight road, UserError for a
    file that is not a film.
    """
    header = read_film_header(path)
    fps = header.fps or DEFAULT_FPS
    total = min(header.count / fps, longest_s) if header.count else longest_s
    film = Film(path)

    def timed() -> Iterator[tuple[float, Picture]]:
        for picture in film.pictures():
            if picture.image is None:
                continue
            time_s = picture.number / fps
            if time_s >= longest_s:
                return
            report(time_s, total)
            yield time_s, cv2.cvtColor(picture.image, cv2.COLOR_BGR2RGB).astype(np.uint8)

    try:
        found, shown = _calibrate(timed(), make_lens, lane_width_m, total / SHOWN)
    except NotCalibrated as error:
        told = f"; {film.fault}" if film.fault else ""
        raise NotCalibrated(f"{path}: {error}{told}") from error
    return CalibratedDrive(found, shown, film.fault)


def calibrate_pictures(
    paths: Sequence[Path],
    make_lens: MakeLens,
    lane_width_m: float | None = None,
    report: Report = lambda done, total: None,
) -> CalibratedDrive:
    """Estimate the camera of the pictures `paths` of a drive, which are in the order of time. Of
    more than 600 pictures, 600 that are spread evenly over the drive are used.

    `make_lens`, `lane_width_m`: as for `calibrate_film`; `report(done, total)` is called with
    numbers of pictures. Raises NotCalibrated if too few pictures show a marked straight road.
    """

    count = min(len(paths), KEPT)
    used = [paths[i] for i in np.linspace(0, len(paths) - 1, count).astype(int).tolist()]

    def timed() -> Iterator[tuple[float, Picture]]:
        for number, path in enumerate(used):
            report(float(number), float(count))
            yield PICTURE_S * number, read_whole_image(path)

    found, shown = _calibrate(timed(), make_lens, lane_width_m, count / SHOWN)
    unused = f"{count} of {len(paths)} pictures were used, spread evenly over the drive"
    return CalibratedDrive(found, shown, unused=unused if count < len(paths) else "")


def _calibrate(
    timed: Iterator[tuple[float, Picture]],
    make_lens: MakeLens,
    lane_width_m: float | None,
    show_every_s: float,
) -> tuple[DriveEstimate, list[Picture]]:
    first = next(timed, None)
    if first is None:
        raise NotCalibrated("it has no picture")
    size = (first[1].shape[1], first[1].shape[0])
    calibration = DriveCalibration(make_lens(size), lane_width_m)
    shown: list[Picture] = []
    for time_s, picture in chain([first], timed):
        if (picture.shape[1], picture.shape[0]) != size:
            raise UserError(
                f"the pictures are of different sizes ({size[0]} x {size[1]}, then "
                f"{picture.shape[1]} x {picture.shape[0]} px); give pictures of one camera"
            )
        calibration.add(picture, time_s)
        if time_s >= (len(shown) + 0.5) * show_every_s and len(shown) < SHOWN:
            shown.append(picture)
    return calibration.estimate(), shown
