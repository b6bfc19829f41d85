"""The configuration of a calibration: its fields are the options of `mtlnet calibrate`."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from typer import Argument, Option


@dataclass(frozen=True)
class CalibrateConfig:
    """Settings of a calibration from a film, from pictures of a drive or from pictures of a
    board."""

    inputs: Annotated[
        list[str],
        Argument(help="A film of a drive, or pictures of a board (files, folders, patterns)."),
    ]
    out: Annotated[Path, Option(help="Camera file to write.")] = Path("camera.yaml")
    board: Annotated[
        str,
        Option(
            help="Board in the pictures: inner corners of a chessboard (9x6), or a ChArUco board "
            "as charuco:5x7:4X4_50:0.75 (squares, dictionary, side of a marker in squares).",
            show_default="a chessboard; its corners are counted",
        ),
    ] = ""
    fisheye: Annotated[
        bool, Option("--fisheye", help="The board was taken with a fisheye lens.")
    ] = False
    drive: Annotated[
        bool, Option("--drive", help="The pictures are of a drive, in the order of time.")
    ] = False
    camera: Annotated[
        Path | None,
        Option(
            help="Camera file that contains the lens, for example from a calibration with a board.",
            show_default="none",
        ),
    ] = None
    fov_y_deg: Annotated[
        float | None,
        Option(
            "--fov-y-deg",
            "--fov",
            help="Vertical field of view of the film or pictures, degrees.",
            show_default="a guess: 65 degrees along the longer side",
        ),
    ] = None
    photo: Annotated[
        Path | None,
        Option(
            help="Photo of the same camera; its EXIF states the focal length.", show_default="none"
        ),
    ] = None
    lane_width_m: Annotated[
        float | None,
        Option("--lane-width", help="Width of the lane driven in, m.", show_default="3.6, assumed"),
    ] = None
    page: Annotated[
        Path | None,
        Option(
            "--report",
            help="HTML page to write: pictures with the result drawn in.",
            show_default="none",
        ),
    ] = None
