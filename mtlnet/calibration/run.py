"""`mtlnet calibrate`: makes a camera file from pictures of a board, from a film, or from
consecutive pictures of a drive."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from mtlnet.calibration.board import calibrate_board
from mtlnet.calibration.config import CalibrateConfig
from mtlnet.calibration.drive import CalibratedDrive, Report, calibrate_film, calibrate_pictures
from mtlnet.calibration.film import check_lane_width
from mtlnet.calibration.lens import KnownLens, find_lens
from mtlnet.sources.find import find_sources
from mtlnet.sources.kinds import SourceKind, kind_of
from runtime.camera_file import read_camera, write_camera
from runtime.files import check_folder, require_other_file
from trackfeatures.camera import CameraParameters
from trackfeatures.errors import UserError


def calibrate(
    config: CalibrateConfig, report: Report = lambda done, total: None
) -> tuple[dict[str, Any], str]:
    """Calibrate the camera and write its file; returns the result of `--json`, and a line of text.

    Raises UserError, also for a truncated or damaged film. In that case the camera file has been
    written if the readable part of the film is sufficient.
    """
    check_folder(config.out)
    if config.page is not None:
        check_folder(config.page)
    check_lane_width(config.lane_width_m)
    paths = _files(config.inputs)
    _require_kept(config, paths)
    films = [path for path in paths if kind_of(path) is SourceKind.FILM]
    _require_options(config, drive=bool(films or config.drive))
    if films or config.drive:
        return _calibrate_drive(config, paths, films, report)
    return _calibrate_board(config, paths)


def _require_kept(config: CalibrateConfig, paths: Sequence[Path]) -> None:
    """Raise UserError if an output is a file to read. Only --out can be the file of --camera, whose
    lens it then keeps."""
    read = [*paths, *([config.photo] if config.photo is not None else [])]
    require_other_file(config.out, read)
    if config.page is not None:
        read += [config.camera] if config.camera is not None else []
        require_other_file(config.page, read, "--report")
        if config.page.resolve() == config.out.resolve():
            raise UserError(f"--out and --report are the same file, {config.out}; give another one")


def _require_options(config: CalibrateConfig, *, drive: bool) -> None:
    """Raise UserError for options that the other kind of calibration has."""
    if drive and (config.board or config.fisheye):
        raise UserError(
            "--board and --fisheye are for pictures of a board; for a drive leave them out, and "
            "give the lens with --camera"
        )
    of_drive = (config.camera, config.fov_y_deg, config.photo, config.lane_width_m)
    if not drive and any(value is not None for value in of_drive):
        raise UserError(
            "--camera, --fov-y-deg, --photo and --lane-width are for a drive; for pictures of a "
            "drive give --drive, for pictures of a board leave these options out"
        )


def _files(inputs: Sequence[str]) -> list[Path]:
    sources = find_sources(list(inputs))
    for source in sources:
        if source.problem:
            raise UserError(source.problem)
        if source.kind not in (SourceKind.IMAGE, SourceKind.FILM):
            raise UserError(
                f"{source.name} is a {source.kind.value}; give a film of a drive, or pictures"
            )
    return [source.path for source in sources]


def _calibrate_board(config: CalibrateConfig, paths: list[Path]) -> tuple[dict[str, Any], str]:
    found = calibrate_board(paths, config.board, CameraParameters(), config.fisheye)
    camera = found.camera
    line = (
        f"focal length {camera.focal_px:.2f} px, error {found.error_px:.3f} px over {found.used} "
        f"of {len(paths)} pictures of the board {found.board}"
    )
    comment = (
        f"mtlnet calibrate: {line}\nThe mount is assumed; with this file as --camera, "
        "`mtlnet calibrate drive.mp4` estimates it."
    )
    write_camera(config.out, camera, comment)
    if config.page is not None:
        from mtlnet.calibration.page import write_board_page

        write_board_page(config.page, found)
    result = {
        "camera": camera.as_dict(),
        "board": found.board,
        "error_px": found.error_px,
        "focal_std_px": found.focal_std_px,
        "pictures": [
            {"file": str(p.path), "error_px": None if p.problem else p.error_px, "note": p.problem}
            for p in found.pictures
        ],
    }
    return result, line


def _calibrate_drive(
    config: CalibrateConfig, paths: list[Path], films: list[Path], report: Report
) -> tuple[dict[str, Any], str]:
    if films and len(paths) > 1:
        raise UserError(f"{films[0]} is a film; give it alone: a film is of one camera and mount")
    model = CameraParameters()
    given = None if config.camera is None else read_camera(config.camera, model)

    def make_lens(size: tuple[int, int]) -> KnownLens:
        photo = config.photo or (None if films else _with_exif(paths[0]))
        return find_lens(size, model, given, config.fov_y_deg, photo)

    if films:
        drive = calibrate_film(films[0], make_lens, config.lane_width_m, report)
    else:
        drive = calibrate_pictures(paths, make_lens, config.lane_width_m, report)
    return _write_drive(config, drive)


def _with_exif(path: Path) -> Path | None:
    """Return `path` if the picture's EXIF contains the focal length, else None."""
    from mtlnet.calibration.lens import photo_focal_share

    try:
        photo_focal_share(path)
    except UserError:
        return None
    return path


def _write_drive(config: CalibrateConfig, drive: CalibratedDrive) -> tuple[dict[str, Any], str]:
    line = drive.found.about() + (f"; {drive.unused}" if drive.unused else "")
    write_camera(config.out, drive.found.camera, f"mtlnet calibrate: {line}")
    if config.page is not None:
        from mtlnet.calibration.page import write_drive_page

        write_drive_page(config.page, drive, str(config.inputs[0]))
    if drive.fault:
        raise UserError(f"{drive.fault}; {config.out} was written from them: {line}")
    return drive.found.as_json(), line
