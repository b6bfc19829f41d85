"""Reads and writes `labels.csv`, the labels of a user's own pictures, with one row per picture.

A header names the columns, in any order: `file`, a path relative to the folder; `ml`, `mr`, `l`,
`m`, `r`, distances in m, negative to the left, empty where the distance is absent; `angle`, rad,
positive when the car points to the right of the track; `heading`, the class of the road: left,
straight or right. `l`, `m`, `r` and `heading` can be `?` (unknown); an unknown label adds no loss
and is not evaluated. The columns in `OPTIONAL` can be left out, and their cells can be empty.
"""

import csv
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from io import StringIO
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from numpy.typing import NDArray

import trackfeatures as tf
from runtime.files import atomic_write
from trackfeatures.coding import IN_LANE_WIDTH_LIMIT_M, UNKNOWN_M
from trackfeatures.errors import UserError
from trackfeatures.road_class import UNKNOWN_HEADING

LABELS = "labels.csv"
COLUMNS = ("file", *tf.MARKINGS, "angle", "heading")
OPTIONAL = ("drive", "light", "camera", "pitch_deg", "curvature_1pm", "std_m", "std_rad")
UNKNOWN = "?"
MAY_BE_UNKNOWN = ("l", "m", "r", "heading")
MARKING_LIMITS_M = {
    "ml": (-5.5, -0.5),
    "mr": (0.5, 5.5),
    "l": (-6.7, -1.5),
    "m": (-2.0, 2.7),
    "r": (1.5, 6.7),
}
"""Allowed distances, m. The network's coding would clip a distance outside its range, and would
read `m` as absent from 2.75 m, and `l` and `r` from 6.75 m from the car."""
MAX_LANE_WIDTH_M = IN_LANE_WIDTH_LIMIT_M - 1e-3
"""Maximum of `mr - ml`, m. The coding would read a wider lane as absent; the margin of 1 mm covers
the rounding to float32."""
ANGLE_LIMIT_RAD = 0.5
ROAD_CLASSES = {kind.name.lower(): int(kind) for kind in tf.RoadClass}

Cells = dict[str, str]


@dataclass(frozen=True)
class CustomLabels:
    """Labels of N pictures: `distances` (N, 5) m, NaN where absent, infinity where unknown; `angle`
    (N,) rad; `heading` (N,), the number of the class of the road, or `UNKNOWN_HEADING`."""

    distances: NDArray[np.float32]
    angle: NDArray[np.float32]
    heading: NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.angle)

    def take(self, rows: Any) -> "CustomLabels":
        """Return the labels of the pictures selected by `rows`: indices, a mask (N,) or a slice."""
        return CustomLabels(self.distances[rows], self.angle[rows], self.heading[rows])


@dataclass(frozen=True)
class LabelledPicture:
    """One row of `labels.csv` without its labels."""

    line: int
    file: str
    """Path of the picture, relative to the folder."""
    drive: str = ""
    """Name of the drive. Pictures of one drive are similar, so they are weighted and held out
    together."""
    light: str = ""
    """Name of the light or weather, by which evaluations group the pictures."""
    camera: str = ""
    """Camera file of this picture, relative to the folder; empty: the folder's camera."""
    pitch_deg: float | None = None
    """Pitch of the camera in this picture, degrees, positive downwards; None: as in the camera
    file."""
    curvature: float = 0.0
    """Curvature of the road, 1/m, positive to the left; used to draw the markings."""
    std_m: float = 0.0
    """Standard deviation of the label's distances, m."""
    std_rad: float = 0.0
    """Standard deviation of the label's angle, rad."""


def read_labels(path: Path) -> tuple[list[LabelledPicture], CustomLabels]:
    """Read a `labels.csv`; returns its pictures, at least one, and their labels.

    File names may contain bytes that are not UTF-8. Raises UserError with the line of a faulty row.
    """
    pictures: list[LabelledPicture] = []
    rows: list[tuple[list[float], float, int]] = []
    for line, cells in read_cells(path):
        try:
            picture, *values = _parse(line, cells)
        except ValueError as error:
            raise UserError(f"{path}, line {line}: {error}") from None
        pictures.append(picture)
        rows.append(values)  # type: ignore[arg-type]  # the types of `_parse`
    if not pictures:
        raise UserError(f"{path} names no images")
    labels = CustomLabels(
        np.array([row[0] for row in rows], np.float32),
        np.array([row[1] for row in rows], np.float32),
        np.array([row[2] for row in rows], np.int64),
    )
    return pictures, labels


def read_cells(path: Path) -> list[tuple[int, Cells]]:
    """Read a `labels.csv`; returns, for each row, the line number and the cells by column, without
    surrounding spaces. File names are normalized (`normal_name`).

    Raises UserError for a wrong header, a row with missing or surplus cells, and a repeated file.
    """
    found: list[tuple[int, Cells]] = []
    seen: dict[str, int] = {}
    with path.open(newline="", encoding="utf-8-sig", errors="surrogateescape") as file:
        reader = csv.DictReader(file, strict=True)
        try:
            names = [name.strip() for name in reader.fieldnames or ()]
            reader.fieldnames = names
            _check_head(path, names)
            for row in reader:
                if None in row or None in row.values():
                    raise UserError(
                        f"{path}, line {reader.line_num}: it has not {len(names)} values"
                    )
                cells = {name: text.strip() for name, text in row.items()}
                name = cells["file"] = normal_name(cells["file"])
                if name in seen:
                    raise UserError(
                        f"{path}, line {reader.line_num}: {name} stands in line {seen[name]} "
                        "already"
                    )
                seen[name] = reader.line_num
                found.append((reader.line_num, cells))
        except csv.Error as error:
            raise UserError(f"{path}, after line {reader.line_num}: {error}") from error
    return found


def write_cells(path: Path, rows: list[Cells]) -> None:
    """Replace a `labels.csv` by a file with the given rows, atomically; it is synced to disk on
    return."""
    used = [name for name in OPTIONAL if any(row.get(name) for row in rows)]
    text = StringIO()
    writer = csv.DictWriter(text, (*COLUMNS, *used), restval="", lineterminator="\n")
    writer.writeheader()
    writer.writerows({name: row.get(name, "") for name in (*COLUMNS, *used)} for row in rows)
    atomic_write(path, text.getvalue().encode("utf-8", "surrogateescape"), fsync=True)


def normal_name(name: str) -> str:
    """Return the shortest path that is written like `name`, `b.jpg` for `./b.jpg`; "" for ""."""
    return str(PurePosixPath(name)) if name else name


def check_name(name: str) -> None:
    """Raise UserError if `read_cells` would not return the file name `name` as it was written."""
    if name != name.strip() or "\r" in name:
        raise UserError(
            f"the file name {name!r} cannot be written to {LABELS}: rename the file, without "
            "spaces at the ends of its name and without carriage returns"
        )


def check_cells(cells: Cells) -> None:
    """Raise UserError with the reason if `cells`, a row that is to be written, is faulty."""
    try:
        _parse(0, {name: cells.get(name, "") for name in (*COLUMNS, *OPTIONAL)})
    except ValueError as error:
        raise UserError(str(error)) from None


def path_within(name: str) -> bool:
    """Return whether `name`, read from a table, is a relative path inside the table's folder."""
    path = PurePosixPath(name)
    return bool(name) and name != UNKNOWN and not path.is_absolute() and ".." not in path.parts


def _check_head(path: Path, names: list[str]) -> None:
    missing = [name for name in COLUMNS if name not in names]
    unknown = [name for name in names if name not in (*COLUMNS, *OPTIONAL)]
    twice = [name for name in names if names.count(name) > 1]
    if missing or unknown or twice:
        raise UserError(
            f"{path} has the columns {', '.join(names) or 'none'}; its first line must "
            f"name {', '.join(COLUMNS)}, each once, and may name {', '.join(OPTIONAL)}, with "
            "commas between them, in UTF-8"
        )


def _parse(line: int, cells: Cells) -> tuple[LabelledPicture, list[float], float, int]:
    """Convert the cells of a row to its picture, distances in m (NaN where absent), angle in rad
    and class.

    Raises ValueError with the reason for a faulty row.
    """
    for column, text in cells.items():
        if text == UNKNOWN and column not in MAY_BE_UNKNOWN:
            raise ValueError(
                f"{column} is `?`, which only {', '.join(MAY_BE_UNKNOWN)} may be: give its value, "
                "or leave the picture out"
            )
    name = cells["file"]
    if not path_within(name):
        raise ValueError(f"the file {name!r} is no path within the folder")
    found = {marking: _distance(marking, cells[marking]) for marking in tf.MARKINGS}
    _check_pairs(found)
    angle = _number("angle", cells["angle"])
    if not abs(angle) <= ANGLE_LIMIT_RAD:
        raise ValueError(
            f"angle is {angle:g}; it must be within {ANGLE_LIMIT_RAD} rad (radians, not degrees)"
        )
    heading = UNKNOWN_HEADING
    if cells["heading"] != UNKNOWN:
        if cells["heading"] not in ROAD_CLASSES:
            raise ValueError(
                f"heading is {cells['heading']!r}; give {', '.join(ROAD_CLASSES)} or ?"
            )
        heading = ROAD_CLASSES[cells["heading"]]
    return _picture(line, cells), [found[m] for m in tf.MARKINGS], angle, heading


def _check_pairs(found: dict[str, float]) -> None:
    if math.isnan(found["ml"]) != math.isnan(found["mr"]):
        raise ValueError("ml and mr are the two sides of one lane: give both or none")
    if found["mr"] - found["ml"] > MAX_LANE_WIDTH_M:
        raise ValueError(
            f"the lane from ml to mr is {found['mr'] - found['ml']:g} m wide; it must be under "
            f"{IN_LANE_WIDTH_LIMIT_M:g} m, because a wider lane would count as absent"
        )
    beside = (found["l"], found["r"])
    if math.isnan(found["m"]) and not all(map(math.isnan, beside)):
        raise ValueError("l and r are the markings next to m: without m they must be empty")
    if found["m"] == UNKNOWN_M and not all(value == UNKNOWN_M for value in beside):
        raise ValueError("l and r are the markings next to m: where m is `?`, they must be `?` too")


def _picture(line: int, cells: Cells) -> LabelledPicture:
    """Return the picture of a row, with its optional cells. Raises ValueError for a faulty cell."""
    camera = cells.get("camera", "")
    if camera and not path_within(camera):
        raise ValueError(f"the camera {camera!r} is no path within the folder")
    pitch = _optional(cells, "pitch_deg", lambda value: abs(value) <= 30, "within 30 degrees")
    curvature = _optional(cells, "curvature_1pm", lambda value: abs(value) <= 0.2, "within 0.2 1/m")
    std = [
        _optional(cells, name, lambda value: 0 <= value < 10, "0 or more, and under 10")
        for name in ("std_m", "std_rad")
    ]
    texts = (cells["file"], cells.get("drive", ""), cells.get("light", ""), camera)
    return LabelledPicture(line, *texts, pitch, curvature or 0.0, std[0] or 0.0, std[1] or 0.0)


def _optional(
    cells: Cells, name: str, holds: Callable[[float], bool], expected: str
) -> float | None:
    text = cells.get(name, "")
    if not text:
        return None
    value = _number(name, text)
    if not holds(value):
        raise ValueError(f"{name} is {value:g}; it must be {expected}")
    return value


def _distance(marking: str, text: str) -> float:
    if not text:
        return math.nan
    if text == UNKNOWN:
        return UNKNOWN_M
    value = _number(marking, text)
    low, high = MARKING_LIMITS_M[marking]
    if not low <= value <= high:
        raise ValueError(
            f"{marking} is {value:g} m; it must be from {low:g} to {high:g} (left negative), or "
            "empty where there is none"
        )
    return value


def _number(name: str, text: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise ValueError(f"{name} is {text!r}, not a number") from None


def lane_cells(ml: float, mr: float) -> Cells:
    """Return the cells of the five distances, from the signed distances `ml` and `mr` (m) to the
    two markings of the car's lane.

    `ml` and `mr` are filled in if the car is at least 0.5 m from both markings. If it is more than
    1.2 m from both, `l`, `m` and `r` are empty. Otherwise `m` is the nearer marking, `l` or `r` is
    the marking at the lane's opposite side, and the marking beyond the nearer one is unknown.
    """
    near = min(-ml, mr)
    in_lane = near >= tf.IN_LANE_MARGIN_M
    cells = {"ml": _metres(ml) if in_lane else "", "mr": _metres(mr) if in_lane else ""}
    if near > tf.ON_MARKING_REACH_M:
        return {**cells, "l": "", "m": "", "r": ""}
    if -ml < mr:
        return {**cells, "l": UNKNOWN, "m": _metres(ml), "r": _metres(mr)}
    return {**cells, "l": _metres(ml), "m": _metres(mr), "r": UNKNOWN}


def lane_sides(metres: Mapping[str, float | None]) -> tuple[float, float] | None:
    """Return the signed distances (left, right), m, to the two markings of one lane, from the
    distances by name of the marking; None is an absent or unknown distance.

    The pair is `ml` and `mr`. Without it, the pair is the lane on the car's side of `m`: `l` and
    `m` if `m` is right of the car, else `m` and `r`. Without this lane, the pair is the lane on the
    far side of `m`. None if no pair is present. `trackfeatures.definitions.lane_offset` uses the
    same order.
    """
    beside = ("l", "m"), ("m", "r")
    is_right = (metres["m"] or 0.0) > 0
    for pair in (("ml", "mr"), *(beside if is_right else reversed(beside))):
        left, right = (metres[name] for name in pair)
        if left is not None and right is not None:
            return left, right
    return None


def _metres(value: float) -> str:
    return f"{value:.3f}"
