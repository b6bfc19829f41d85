"""Converts a table of lane labels, measured at the camera, to a folder with a `labels.csv`: `mtlnet
label FOLDER --import FILE`.

Columns: `file`, relative to the table; `x_left_m`, `x_right_m`, positions of the lane's markings at
the camera, positive to the left; `heading_rad`, angle of the camera to the road, positive to the
right; `fov_y_deg` and `camera_height_m` of the camera. Optional: `focal_px` and `horizon_y_px`,
which give the pitch, `curvature_1pm`, positive to the left, `drive` and `light`. Other columns are
ignored. The cameras are pinholes.
"""

import csv
import filecmp
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from pathlib import Path, PurePosixPath
from statistics import median
from typing import Any

from mtlnet.data.labels_file import (
    LABELS,
    UNKNOWN,
    Cells,
    check_cells,
    check_name,
    lane_cells,
    normal_name,
    path_within,
    write_cells,
)
from mtlnet.inference.image_decoding.decode import read_whole_image
from runtime.camera_file import write_camera
from runtime.files import atomic_write
from trackfeatures.camera import CameraParameters
from trackfeatures.errors import UserError
from trackfeatures.road_class import BEND_CURVATURE

NEEDED = ("file", "x_left_m", "x_right_m", "heading_rad", "fov_y_deg", "camera_height_m")
CAMERAS = "cameras"


@dataclass(frozen=True)
class LabelStd:
    """Standard deviations of the labelled distances (`metres`) and angles (`radians`) in the files
    that match the wildcard `pattern`."""

    pattern: str
    metres: float
    radians: float

    def applies_to(self, file: str) -> bool:
        """Return whether the path of a file, or its name without the folders, matches."""
        return any(fnmatchcase(name, self.pattern) for name in (file, PurePosixPath(file).name))


def parse_label_std(texts: Sequence[str]) -> list[LabelStd]:
    """Parse the values of --label-std, for example "0.06,0.006" (all files) and
    "night_*=0.16,0.012" (files that match the pattern). The numbers are the standard deviations in
    m and rad. Raises UserError for any other form."""
    found = []
    for text in texts:
        pattern, _, numbers = text.rpartition("=")
        try:
            metres, radians = (float(part) for part in numbers.split(","))
        except ValueError:
            raise UserError(
                f"--label-std is {text!r}; give METRES,RADIANS or PATTERN=METRES,RADIANS, such as "
                "0.06,0.006"
            ) from None
        found.append(LabelStd(pattern or "*", metres, radians))
    return found


def import_labels(table: Path, folder: Path, stds: Sequence[LabelStd] = ()) -> dict[str, Any]:
    """Copy the pictures of a table to `folder`, with `labels.csv` and camera files.

    A file gets the standard deviations of the last entry of `stds` whose pattern matches its path
    or name. Returns a dict: `folder`, and the numbers of `pictures` and `cameras`. Raises UserError
    for a faulty row, for a pattern that matches no file, if `folder` has labels already, and if a
    picture would replace another file; then nothing is written. A picture that is already in
    `folder` is not copied.
    """
    if (folder / LABELS).exists():
        raise UserError(f"{folder / LABELS} exists; give a new folder")
    found: list[tuple[CameraParameters, Cells]] = []
    for line, row in _rows(table):
        try:
            camera, cells = _converted(table.parent, row, stds)
            check_cells(cells)
            _require_free(table.parent / row["file"], folder / row["file"])
        except (UserError, ValueError) as error:
            raise UserError(f"{table}, line {line}: {error}") from None
        found.append((camera, cells))
    for std in stds:
        if not any(std.applies_to(cells["file"]) for _, cells in found):
            raise UserError(
                f"--label-std '{std.pattern}={std.metres:g},{std.radians:g}': no file of {table} "
                "matches the pattern"
            )
    pitches: dict[CameraParameters, list[float]] = {}
    for camera, cells in found:
        given = [float(cells["pitch_deg"])] if "pitch_deg" in cells else []
        pitches.setdefault(camera, []).extend(given)
    cameras: dict[CameraParameters, str] = {}
    for camera, cells in found:
        source, target = table.parent / cells["file"], folder / cells["file"]
        if not target.exists():
            target.parent.mkdir(parents=True, exist_ok=True)
            atomic_write(target, source.read_bytes())
        if camera not in cameras:
            cameras[camera] = _write_camera(folder, camera, pitches[camera])
        cells["camera"] = cameras[camera]
    write_cells(folder / LABELS, [cells for _, cells in found])
    return {"folder": str(folder), "pictures": len(found), "cameras": len(cameras)}


def _require_free(source: Path, target: Path) -> None:
    """Raise UserError if `target` is a file with other contents than `source`."""
    if target.exists() and not filecmp.cmp(source, target, shallow=False):
        raise UserError(f"{target} exists and is another file; give a new folder")


def _rows(table: Path) -> list[tuple[int, dict[str, str]]]:
    """Read the table; returns, for each row, the line number and the cells by column. Raises
    UserError for a faulty header, a faulty row and a repeated file.

    File names are normalized (`normal_name`). Bytes that are not UTF-8 become surrogates, as in
    file names.
    """
    lines: dict[str, int] = {}
    rows: list[tuple[int, dict[str, str]]] = []
    with table.open(newline="", encoding="utf-8-sig", errors="surrogateescape") as file:
        reader = csv.DictReader(file, strict=True)
        try:
            names = reader.fieldnames or ()
            missing = [name for name in NEEDED if name not in names]
            if missing:
                raise UserError(
                    f"{table} has no column {', '.join(missing)}; it must have {', '.join(NEEDED)}"
                )
            for row in reader:
                where = f"{table}, line {reader.line_num}"
                if None in row or None in row.values():
                    raise UserError(f"{where}: it does not have {len(names)} values")
                row["file"] = normal_name(row["file"])
                first = lines.setdefault(row["file"], reader.line_num)
                if first != reader.line_num:
                    raise UserError(f"{where}: {row['file']} stands in line {first} already")
                rows.append((reader.line_num, row))
        except csv.Error as error:
            raise UserError(f"{table}, after line {reader.line_num}: {error}") from error
    if not rows:
        raise UserError(f"{table} names no pictures")
    return rows


def _converted(
    folder: Path, row: dict[str, str], stds: Sequence[LabelStd]
) -> tuple[CameraParameters, Cells]:
    """Return the camera (without its pitch) and the cells of `labels.csv` for a row of the table.
    Raises UserError or ValueError."""
    if not path_within(row["file"]):
        raise UserError(f"the file {row['file']!r} is not a path inside the table's folder")
    check_name(row["file"])
    camera_height_m = _number(row, "camera_height_m")
    if camera_height_m <= 0:
        raise UserError(f"camera_height_m is {camera_height_m:g}; it must be above 0")
    height, width = read_whole_image(folder / row["file"]).shape[:2]
    camera = CameraParameters(
        width=width,
        height=height,
        fov_y_deg=_number(row, "fov_y_deg"),
        x=0.0,
        z=camera_height_m - CameraParameters.cg_height_m,
    )
    curvature = _number(row, "curvature_1pm") if row.get("curvature_1pm") else 0.0
    bend = "left" if curvature > 0 else "right"
    cells = {
        "file": row["file"],
        **lane_cells(-_number(row, "x_left_m"), -_number(row, "x_right_m")),
        "angle": f"{_number(row, 'heading_rad'):.6g}",
        # A gentler bend can be sharper 20 m ahead, which also determines the class.
        "heading": bend if abs(curvature) >= BEND_CURVATURE else UNKNOWN,
        "drive": row.get("drive") or "",
        "light": row.get("light") or "",
        "curvature_1pm": f"{curvature:.6g}",
    }
    if row.get("focal_px") and row.get("horizon_y_px"):
        down = (height - 1) / 2 - _number(row, "horizon_y_px")
        cells["pitch_deg"] = f"{math.degrees(math.atan2(down, _number(row, 'focal_px'))):.6g}"
    for std in stds:
        if std.applies_to(row["file"]):
            cells.update(std_m=f"{std.metres:g}", std_rad=f"{std.radians:g}")
    return camera, cells


def _number(row: dict[str, str], name: str) -> float:
    try:
        value = float(row[name])
    except (TypeError, ValueError):
        value = math.nan
    if not math.isfinite(value):
        raise UserError(f"{name} is {row[name]!r}, not a number")
    return value


def _write_camera(folder: Path, camera: CameraParameters, pitches_deg: Sequence[float]) -> str:
    """Write the file of a camera, with the median of the pitches of its pictures (degrees) or, if
    none is known, a pitch of 0; returns its name within `folder`, which no other file has."""
    base = f"{CAMERAS}/{camera.width}x{camera.height}-{camera.fov_y_deg:g}deg"
    name, number = f"{base}.yaml", 2
    while (folder / name).exists():  # for example of a camera that differs only in its height
        name, number = f"{base}-{number}.yaml", number + 1
    (folder / CAMERAS).mkdir(exist_ok=True)
    comment = "pitch_deg is the median of the pitches of the pictures in labels.csv, 0 if none."
    write_camera(folder / name, replace(camera, pitch_deg=median(pitches_deg or [0.0])), comment)
    return name
