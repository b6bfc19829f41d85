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
        Argument(
            help="Film of a drive, or pictures of a board or (with --drive) of a drive: files, "
            "folders or wildcard patterns."
        ),
    ]
    out: Annotated[Path, Option(help="Camera file to write.")] = Path("camera.yaml")
    board: Annotated[
        str,
        Option(
            help="Board in the pictures: the numbers of inner corners of a chessboard, for "
            "example 9x6; or for a ChArUco board charuco:5x7:4X4_50:0.75 (numbers of "
            "squares, ArUco dictionary, side of a marker divided by the side of a "
            "square). Only for pictures of a board.",
            show_default="the chessboard that most pictures show",
        ),
    ] = ""
    fisheye: Annotated[
        bool, Option("--fisheye", help="The lens is a fisheye lens. Only for pictures of a board.")
    ] = False
    drive: Annotated[
        bool,
        Option(
            "--drive",
            help="The inputs are pictures of a drive in the order of time, not of a board.",
        ),
    ] = False
    camera: Annotated[
        Path | None,
        Option(
            help="For a drive: camera file from which the lens is taken, for example from a "
            "calibration with a board.",
            show_default="none",
        ),
    ] = None
    fov_y_deg: Annotated[
        float | None,
        Option(
            "--fov-y-deg",
            "--fov",
            help="For a drive: vertical field of view of the film or pictures, degrees. "
            "--camera is used instead if both are given.",
            show_default="of --camera, --photo or the pictures' EXIF; else assumed: 65 degrees "
            "along the longer side",
        ),
    ] = None
    photo: Annotated[
        Path | None,
        Option(
            help="For a drive: JPEG photo of the same camera. The focal length is read from "
            "its EXIF data, unless --camera or --fov-y-deg is given.",
            show_default="none",
        ),
    ] = None
    lane_width_m: Annotated[
        float | None,
        Option(
            "--lane-width",
            help="For a drive: width of the lane in which the car drives, m.",
            show_default="3.6, assumed",
        ),
    ] = None
    page: Annotated[
        Path | None,
        Option(
            "--report",
            help="HTML page to write: pictures with the result drawn into them.",
            show_default="none",
        ),
    ] = None
