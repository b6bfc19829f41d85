"""The folder whose pictures are labelled: its pictures, their cameras, the rows of `labels.csv`.

Each change rewrites `labels.csv` atomically, starting from the current file: rows of other pictures
and columns that the page does not show are kept. Only files inside the folder are read.
"""

from hashlib import sha256
from pathlib import Path
from threading import Lock

import numpy as np
from numpy.typing import NDArray

from mtlnet.data.labels_file import (
    LABELS,
    UNKNOWN,
    Cells,
    check_cells,
    check_name,
    lane_cells,
    lane_sides,
    read_cells,
    write_cells,
)
from mtlnet.inference.image_decoding.decode import read_whole_image
from mtlnet.inference.rectification import CAMERA_FILE, TOLERANCE, read_camera
from mtlnet.label.geometry import Markings
from mtlnet.sources.kinds import SourceKind, kind_of
from runtime.camera_file import Note, write_camera
from runtime.files import natural_key
from trackfeatures.camera import CameraParameters
from trackfeatures.definitions import MARKINGS
from trackfeatures.errors import UserError
from trackfeatures.road_class import classify_heading

KEPT = ("drive", "light", "camera", "std_m", "std_rad")
"""Columns whose values stay when a label is saved, unless the page sends new ones."""


class LabelChangedError(UserError):
    """The label of a picture has another version than the label that was shown."""


class LabelFolder:
    """A folder with pictures to label. A picture is addressed by its index in the list `files`,
    which does not change."""

    def __init__(
        self,
        folder: Path,
        camera_file: Path | None,
        model: CameraParameters,
        note: Note | None = None,
    ) -> None:
        """Find the pictures in `folder` and its subfolders, and check `labels.csv`.

        `camera_file`: camera of the pictures whose row names no camera; the file is copied into a
        folder that has no camera file. `model`: camera of the model, whose values replace values
        that are missing in a camera file. `note` is called with a line about the values that were
        chosen or assumed for `camera_file`. Raises UserError for a folder without pictures; for a
        picture whose name cannot be written to `labels.csv`; for a folder without a camera file in
        which no row names a camera; for a faulty `labels.csv`; and for a camera file that differs
        from the file in the folder.
        """
        if not folder.is_dir():
            raise UserError(f"there is no folder {folder}; give one with pictures")
        self.folder = folder.resolve()
        self._model = model
        self._lock = Lock()
        self._rows: tuple[object, dict[str, Cells]] = (None, {})
        self._earlier: dict[str, list[Cells | None]] = {}  # for each file its rows before changes
        self._picture: tuple[object, NDArray[np.uint8]] = (None, np.empty(0, np.uint8))
        self.files = self._find()
        if not self.files:
            raise UserError(f"there is no picture in {folder}")
        for name in self.files:
            check_name(name)
        self.rows()  # raises for a faulty file before labelling starts
        own = self.folder / CAMERA_FILE
        if camera_file is not None:
            camera = read_camera(camera_file, model, note)
            if own.exists() and read_camera(own, model) != camera:
                raise UserError(
                    f"{own} describes another camera than {camera_file}; leave --camera out, or "
                    f"delete {own}"
                )
            if not own.exists():
                write_camera(own, camera, f"From {camera_file.name}, by `mtlnet label`.")
        named = any(row.get("camera") for row in self.rows().values())
        if not own.exists() and not named:
            raise UserError(
                f"{folder} has no {CAMERA_FILE}, which is needed to compute metres: "
                "give --camera FILE (`mtlnet calibrate` makes one)"
            )

    def _find(self) -> list[str]:
        found = []
        for path in self.folder.rglob("*"):
            name = path.relative_to(self.folder).as_posix()
            if any(part.startswith(".") for part in path.relative_to(self.folder).parts):
                continue
            within = path.resolve().is_relative_to(self.folder)
            if within and path.is_file() and kind_of(path) is SourceKind.IMAGE:
                found.append(name)
        return sorted(found, key=natural_key)

    def rows(self) -> dict[str, Cells]:
        """Return the rows of `labels.csv`, each a dict from column to text, by the name of the
        picture's file; an empty dict if there is no `labels.csv`.

        The file is read again when it has changed. Do not change the returned dictionary. Raises
        UserError with the line of a faulty row.
        """
        path = self.folder / LABELS
        if not path.is_file():
            return {}
        version = _version(path)
        if self._rows[0] != version:
            rows = {}
            for line, cells in read_cells(path):
                try:
                    check_cells(cells)
                except UserError as error:
                    raise UserError(f"{path}, line {line}: {error}") from None
                rows[cells["file"]] = cells
            self._rows = version, rows
        return self._rows[1]

    def picture(self, number: int) -> NDArray[np.uint8]:
        """Return picture `number` as a read-only uint8 RGB array (H, W, 3). Raises UserError for a
        file that cannot be read or is not in the folder.

        The picture that was read last stays in memory, because each drag of a marking needs it
        again.
        """
        path = self.folder / self.files[number]
        if not path.resolve().is_relative_to(self.folder):
            raise UserError(f"{self.files[number]} leads out of the folder")
        version, (kept, picture) = _version(path), self._picture
        if kept != version:
            picture = read_whole_image(path)
            picture.flags.writeable = False
            self._picture = version, picture
        return picture

    def camera(self, number: int, width: int, height: int) -> CameraParameters:
        """Return the camera of picture `number`, resized to the picture's width and height (px).

        Its pitch is the pitch in the camera file, not the pitch in the picture's row. Raises
        UserError if no camera is known, for a faulty camera file, and for a camera with another
        aspect ratio.
        """
        named = self._last_row(self.files[number]).get("camera")
        name = named or CAMERA_FILE
        path = self.folder / name
        if not named and not path.is_file():
            raise UserError(
                f"no camera is known for {self.files[number]}: start again with --camera FILE, "
                f"which adds {CAMERA_FILE} to the folder"
            )
        if not path.resolve().is_relative_to(self.folder):
            raise UserError(f"the camera {name} leads out of the folder")
        camera = read_camera(path, self._model)
        if abs(width * camera.height / (height * camera.width) - 1) > TOLERANCE:
            raise UserError(
                f"{self.files[number]} is {width} x {height} px, its camera gives {camera.width} x "
                f"{camera.height}: label the camera's whole pictures, at any size"
            )
        return camera.resized(width, height)

    def markings(self, number: int, camera: CameraParameters) -> Markings | None:
        """Return the label of picture `number`, with the pitch of `camera`; None if the picture has
        no label, or if its label does not have the distances to both markings of a lane."""
        row = self.rows().get(self.files[number], {})
        sides = lane_sides(_distances(row))
        if sides is None:
            return None
        curvature = float(row.get("curvature_1pm") or 0.0)
        return Markings(*sides, float(row["angle"]), curvature, camera.pitch_deg)

    def save(
        self, number: int, markings: Markings, heading: str, texts: Cells, version: str = ""
    ) -> Cells:
        """Write the label of picture `number` into `labels.csv`, and return its row of the file.

        `heading` is the class of the road; if it is empty, the class follows from the curvature of
        the markings, which must then be correct 20 m ahead. `texts`: the cells of the columns
        `drive` and `light`; a column that is missing in `texts` keeps its value. If the lane is at
        the same place as in the row's earlier label, the marking beyond the lane keeps its cell.
        `version`: the `row_version` of the row that was shown; "" means that it is not checked.
        Raises LabelChangedError if the row has another version, and UserError for a label out of
        range.
        """
        heading = heading or heading_of(markings)
        with self._lock:
            name, before = self._checked_row(number, version)
            old = self._last_row(name)
            row = {
                **{k: v for k, v in old.items() if k in KEPT},
                **{k: v for k, v in texts.items() if k in ("drive", "light")},
                "file": name,
                **_distance_cells(markings, old),
                "angle": f"{markings.angle:.5f}",
                "heading": heading,
                "pitch_deg": f"{markings.pitch_deg:.3f}",
                "curvature_1pm": f"{markings.curvature:.6f}",
            }
            check_cells(row)
            self._replace(name, row)
            self._earlier.setdefault(name, []).append(before)
        return row

    def remove(self, number: int, version: str = "") -> None:
        """Remove the label of a picture, if it has one. `version`: as for `save`. Raises
        LabelChangedError."""
        with self._lock:
            name, before = self._checked_row(number, version)
            if before is not None:
                self._replace(name, None)
                self._earlier.setdefault(name, []).append(before)

    def undo(self, number: int, version: str = "") -> Cells | None:
        """Undo the last saving or removal of a picture's label by this process, and return the
        restored row; None if the picture had no label. `version`: as for `save`. Raises
        LabelChangedError, and UserError if there is no change to undo."""
        with self._lock:
            name, _ = self._checked_row(number, version)
            if not self._earlier.get(name):
                raise UserError(f"no earlier label of {name} is known")
            self._replace(name, self._earlier[name][-1])
            return self._earlier[name].pop()

    def _checked_row(self, number: int, version: str) -> tuple[str, Cells | None]:
        """Return the file name of a picture and its row, None without one. Raises
        LabelChangedError if the row does not have the version `version` (if this is not "")."""
        name = self.files[number]
        row = self.rows().get(name)
        if version and version != row_version(row):
            raise LabelChangedError(
                f"the label of {name} has changed since it was shown; check the present one"
            )
        return name, row

    def _last_row(self, name: str) -> Cells:
        """Return the row of the picture `name`, or the last row that it had; else an empty dict."""
        rows = [*self._earlier.get(name, ()), self.rows().get(name)]
        return next((row for row in reversed(rows) if row is not None), {})

    def _replace(self, name: str, new: Cells | None) -> None:
        """Rewrite the file with the row `new` for the picture `name`; without a row for None."""
        rows = {each: row for each, row in self.rows().items() if each != name}
        if new is not None:
            rows[name] = new
        if rows:
            write_cells(self.folder / LABELS, [rows[k] for k in sorted(rows, key=natural_key)])
        else:
            (self.folder / LABELS).unlink(missing_ok=True)


def heading_of(markings: Markings) -> str:
    """Return the class of the road that follows from the curvature of the markings."""
    return classify_heading(markings.curvature, markings.curvature).name.lower()


def row_version(row: Cells | None) -> str:
    """Return a text that differs for rows with different cells; None is a missing row.

    Empty cells do not count, because the columns of the file depend on its other rows.
    """
    if row is None:
        return "none"
    cells = sorted((name, text) for name, text in row.items() if text)
    return sha256(repr(cells).encode()).hexdigest()[:16]


def _distances(row: Cells) -> dict[str, float | None]:
    """Return the distances of a row, m, by name; None is an absent or unknown distance."""
    texts = {name: row.get(name, "") for name in MARKINGS}
    return {
        name: float(text) if text not in ("", UNKNOWN) else None for name, text in texts.items()
    }


def _distance_cells(markings: Markings, old: Cells) -> Cells:
    """Return the five cells of the lane `markings`. A cell that would be unknown keeps its text in
    `old` if the lane and the marking `m` in the row `old` are at the same place, to 1 mm."""
    cells = lane_cells(markings.ml, markings.mr)
    before = _distances(old)
    sides = lane_sides(before)
    if sides is None or before["m"] is None or lane_cells(*sides) != cells:
        return cells
    if f"{before['m']:.3f}" != cells["m"]:
        return cells
    return {name: old[name] if text == UNKNOWN else text for name, text in cells.items()}


def _version(path: Path) -> tuple[object, ...]:
    """Return a key of a file, which changes with each change of the file. Raises UserError if the
    file does not exist."""
    try:
        found = path.stat()
    except OSError as error:
        raise UserError(f"{path} cannot be read: {error.strerror}") from error
    return path, found.st_ino, found.st_mtime_ns, found.st_size
