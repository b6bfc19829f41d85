"""Writes the HTML page of a calibration, whose pictures show the corners found on a board, or a
lane drawn with the estimated camera."""

from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from mtlnet.calibration.board import BoardCalibration, BoardPicture
from mtlnet.calibration.drive import CalibratedDrive
from mtlnet.inference.image_decoding.decode import read_whole_image
from runtime.files import atomic_write
from runtime.html import embed_jpeg, render
from trackfeatures.camera import CameraParameters

WIDTH = 640
"""Width of the pictures on the page, px."""
SEEN, PROJECTED, LANE, HORIZON = (0, 200, 60), (255, 60, 0), (255, 120, 0), (0, 160, 255)
ERROR_SCALE = 20.0
"""Factor by which the drawn errors are longer than the errors."""
LANE_AHEAD_M = np.linspace(3.0, 60.0, 120)

Picture = NDArray[np.uint8]


def write_board_page(path: Path, found: BoardCalibration) -> None:
    """Write the page of a board's calibration: each picture with its corners and its error, px."""
    figures = [
        {"jpeg": embed_jpeg(draw_corners(picture)), "title": picture.path.name, "text": about}
        for picture in found.pictures
        if len(picture.corners)
        for about in [picture.problem or f"{picture.error_px:.2f} px"]
    ]
    rows = [
        [p.path.name, f"{p.error_px:.3f}" if not p.problem else "-", f"{len(p.corners)}", p.problem]
        for p in found.pictures
    ]
    values: dict[str, Any] = {
        "title": f"Board {found.board}: {found.used} of {len(found.pictures)} pictures",
        "lines": _lens_lines(found),
        "head": ["picture", "error (px)", "corners", "left out"],
        "rows": rows,
        "note": "Corners found (green); the errors of their projections (red), drawn 20 times as "
        "long.",
        "figures": figures,
    }
    atomic_write(path, render("mtlnet.calibration", "page.html", **values))


def _lens_lines(found: BoardCalibration) -> list[str]:
    fx, fy, cx, cy = found.camera.matrix or (0.0,) * 4
    std = f" +- {found.focal_std_px:.2f}" if found.focal_std_px else ""
    return [
        f"Focal lengths {fx:.2f} and {fy:.2f}{std} px, principal point {cx:.2f}, {cy:.2f} px",
        f"Distortion {found.camera.distortion}: "
        + ", ".join(f"{value:.5f}" for value in found.camera.coefficients),
        f"Error {found.error_px:.3f} px, root mean square",
    ]


def draw_corners(picture: BoardPicture) -> Picture:
    """Return the picture, 640 px wide, with the corners found. If the picture was used, the errors
    of the corners' projections are drawn too, 20 times as long."""
    image = read_whole_image(picture.path)
    scale = WIDTH / image.shape[1]
    image = _scaled(image, scale)
    seen = (picture.corners + 0.5) * scale - 0.5
    for place in np.rint(seen).astype(int):
        cv2.circle(image, (int(place[0]), int(place[1])), 4, SEEN, 1, cv2.LINE_AA)
    if len(picture.projected):
        off = (picture.projected - picture.corners) * scale * ERROR_SCALE
        for start, end in zip(seen, seen + off, strict=True):
            _line(image, np.array([start, end]), PROJECTED)
    return image


def write_drive_page(path: Path, drive: CalibratedDrive, name: str) -> None:
    """Write the page of a drive's calibration: pictures with the horizon and a straight lane, as
    the estimated camera sees them. `name`: name of the film or pictures, for the title."""
    found = drive.found
    std = [found.pitch_std_deg, found.yaw_std_deg, found.roll_std_deg, found.height_std_m]
    camera = found.camera
    values = [camera.pitch_deg, camera.yaw_deg, camera.roll_deg, camera.height_above_road_m]
    names = ["pitch (deg)", "yaw (deg)", "roll (deg)", "height (m)"]
    atomic_write(
        path,
        render(
            "mtlnet.calibration",
            "page.html",
            title=f"Camera of {name}",
            lines=[text for text in (found.about(), drive.unused) if text],
            head=["", "found", "standard deviation"],
            rows=[
                [what, f"{value:.2f}", f"{spread:.2f}"]
                for what, value, spread in zip(names, values, std, strict=True)
            ],
            note="The horizon (blue), and a straight lane of the stated width with the car in its "
            "middle (orange). Its lines should be parallel to the real markings.",
            figures=[
                {
                    "jpeg": embed_jpeg(draw_lane(p, camera, found.lane_width_m)),
                    "title": "",
                    "text": "",
                }
                for p in drive.shown
            ],
        ),
    )


def draw_lane(picture: Picture, camera: CameraParameters, lane_width_m: float) -> Picture:
    """Return the picture, 640 px wide, with the horizon and a straight lane `lane_width_m` wide
    drawn in, as `camera` sees them."""
    image = _scaled(picture, WIDTH / picture.shape[1])
    camera = camera.resized(image.shape[1], image.shape[0])
    road = -camera.cg_height_m
    for side in (-0.5, 0.5):
        left = np.full_like(LANE_AHEAD_M, side * lane_width_m)
        points = np.column_stack([LANE_AHEAD_M, left, np.full_like(left, road)])
        _line(image, camera.project(points), LANE)
    ahead = np.radians(np.arange(-60.0, 61.0, 2.0))
    far = 1e6 * np.column_stack([np.cos(ahead), np.sin(ahead), np.zeros_like(ahead)])
    _line(image, camera.project(far), HORIZON)
    return image


def _scaled(image: Picture, scale: float) -> Picture:
    size = (round(image.shape[1] * scale), round(image.shape[0] * scale))
    return cv2.resize(image, size, interpolation=cv2.INTER_AREA).astype(np.uint8, copy=False)


def _line(image: Picture, points: NDArray[np.float64], colour: tuple[int, int, int]) -> None:
    """Draw the parts of a line (N, 2) px that are near the picture."""
    limit = 4 * max(image.shape)
    near = np.isfinite(points).all(axis=1) & (np.abs(points) < limit).all(axis=1)
    fixed = np.rint(points[near] * 16).astype(np.int32)
    cv2.polylines(image, [fixed], False, colour, 1, cv2.LINE_AA, shift=4)
