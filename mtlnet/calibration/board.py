"""Calibrates a lens from pictures of a chessboard or a ChArUco board, with OpenCV.

Points on the board are in units of the side of a square; pixel centres have whole coordinates.
"""

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from mtlnet.inference.image_decoding.decode import read_whole_image
from mtlnet.inference.image_decoding.errors import ImageError
from trackfeatures.camera import CameraParameters
from trackfeatures.errors import UserError

SMALLEST = (3, 3)
"""Least number of inner corners of a recognised chessboard."""
DICTIONARY, MARKER = "4X4_50", 0.75
MIN_PICTURES = 3
FEW = 8
"""With fewer pictures than this the third radial coefficient of the lens stays 0, because it would
fit the noise."""
MIN_CHARUCO = 8
OUTLIER = 4.0
"""A picture is left out if its error exceeds both this multiple of the median error and 1 px."""
Picture = NDArray[np.uint8]
Corners = NDArray[np.float32]
Finder = Callable[[Picture], tuple[Corners, Corners] | None]
"""A function that returns the corners on the board (N, 3) and in a grayscale picture (N, 2); None
where the picture shows no board."""


class NoBoard(UserError):
    """Raised when the pictures do not allow a calibration of the lens."""


@dataclass(frozen=True)
class BoardPicture:
    """A picture with its corners found (N, 2) px, their projections by the calibrated lens (N, 2)
    px, and the root mean square of their distances, `error_px`. For a picture that is not used,
    `problem` has the reason."""

    path: Path
    corners: NDArray[np.float64]
    projected: NDArray[np.float64]
    error_px: float = 0.0
    problem: str = ""


@dataclass(frozen=True)
class BoardCalibration:
    """The calibrated lens. `focal_std_px` is the standard deviation of the focal length fy, 0 for a
    fisheye lens; `error_px` is the root mean square error over all used corners."""

    camera: CameraParameters
    board: str
    error_px: float
    focal_std_px: float
    pictures: list[BoardPicture]

    @property
    def used(self) -> int:
        """Number of pictures used for the lens."""
        return sum(not picture.problem for picture in self.pictures)


def calibrate_board(
    paths: Sequence[Path], board: str, model: CameraParameters, fisheye: bool = False
) -> BoardCalibration:
    """Calibrate the lens of the camera that took the pictures `paths`, which show one board.

    `board`: inner corners of a chessboard, such as "9x6"; "charuco:5x7" for the squares of a
    ChArUco board, optionally followed by ":DICTIONARY:MARKER", the ArUco dictionary and the side of
    a marker in squares (default ":4X4_50:0.75"); empty: the chessboard that most pictures show.
    `model`: the camera from which the mount is taken. `fisheye`: use OpenCV's fisheye model of the
    lens. Raises NoBoard if fewer than three pictures show the board, for pictures of different
    sizes, and if OpenCV finds no lens.
    """
    pictures = [(path, *_read(path)) for path in paths]
    sizes = {grey.shape for _, grey, _ in pictures if grey is not None}
    if len(sizes) > 1:
        listed = ", ".join(sorted(f"{w} x {h}" for h, w in sizes))
        raise NoBoard(
            f"the pictures are of different sizes ({listed}); give pictures of one camera"
        )
    board, found, size = _find(pictures, board)
    if len(found) < MIN_PICTURES:
        raise _no_board(board, len(found), pictures)
    solved = _solve(found, size, fisheye)
    left_out = _outliers(solved.errors)
    if left_out and len(found) - len(left_out) >= MIN_PICTURES:
        kept = {path: each for path, each in found.items() if path not in left_out}
        solved = _solve(kept, size, fisheye)
    else:
        left_out = {}
    done = []
    for path, _, problem in pictures:
        corners = found[path][1].astype(np.float64) if path in found else np.zeros((0, 2))
        if path in solved.errors:
            projected = solved.projected[path]
            done.append(BoardPicture(path, corners, projected, solved.errors[path]))
        else:
            told = f"left out: its error is {left_out[path]:.2f} px" if path in left_out else ""
            told = told or problem or f"shows no {board} board"
            done.append(BoardPicture(path, corners, np.zeros((0, 2)), problem=told))
    k = solved.matrix
    lens = replace(
        model,
        width=size[0],
        height=size[1],
        matrix=(float(k[0, 0]), float(k[1, 1]), float(k[0, 2]), float(k[1, 2])),
        distortion="fisheye" if fisheye else "opencv",
        coefficients=tuple(map(float, solved.coefficients)),
    )
    return BoardCalibration(lens, board, solved.error, solved.focal_std, done)


def _read(path: Path) -> tuple[Picture | None, str]:
    try:
        picture = read_whole_image(path)
    except ImageError as error:
        return None, str(error)
    return cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY).astype(np.uint8, copy=False), ""


def _find(
    pictures: Sequence[tuple[Path, Picture | None, str]], board: str
) -> tuple[str, dict[Path, tuple[Corners, Corners]], tuple[int, int]]:
    """Return the name of the board, the corners by picture, and the size of the pictures."""
    greys = {path: grey for path, grey, _ in pictures if grey is not None}
    if not greys:
        raise NoBoard(f"none of {len(pictures)} pictures can be read: {pictures[0][2]}")
    first = next(iter(greys.values()))
    if not board:
        board = _recognised(list(greys.values()))
    finder = _finder(board)
    found = {path: corners for path, grey in greys.items() if (corners := finder(grey)) is not None}
    return board, found, (first.shape[1], first.shape[0])


def _recognised(greys: Sequence[Picture]) -> str:
    """Return the size, such as "9x6", of the chessboard found in most pictures; some pictures can
    show only a part of it. Raises NoBoard."""
    flags = cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_LARGER
    counts: Counter[tuple[int, int]] = Counter()
    for grey in greys:
        seen, _, meta = cv2.findChessboardCornersSBWithMeta(grey, SMALLEST, flags)
        if seen:
            counts[max(meta.shape), min(meta.shape)] += 1
    if not counts:
        raise NoBoard(
            f"no chessboard in {len(greys)} pictures; name another board with --board, or give "
            "--drive for pictures of a drive"
        )
    columns, rows = max(counts, key=lambda shape: (counts[shape], shape))
    return f"{columns}x{rows}"


def _no_board(board: str, found: int, pictures: Sequence[object]) -> NoBoard:
    return NoBoard(
        f"{found} of {len(pictures)} pictures show the board {board}; at least {MIN_PICTURES} are "
        "needed, better 15, of the whole board, turned and in all parts of the picture"
    )


def _finder(board: str) -> Finder:
    kind, _, rest = board.rpartition("charuco:")
    parts = (rest if kind or board.startswith("charuco:") else board).split(":")
    try:
        columns, rows = map(int, parts[0].lower().split("x"))
        marker = float(parts[2]) if len(parts) > 2 else MARKER
    except ValueError:
        columns = rows = 0
        marker = 0.0
    if min(columns, rows) < 3 or not 0 < marker < 1 or len(parts) > 3:
        raise NoBoard(f"--board {board} names no board; give e.g. 9x6 or charuco:5x7:4X4_50:0.75")
    if not board.startswith("charuco:"):
        return lambda grey: _chessboard(grey, (columns, rows))
    name = f"DICT_{parts[1] if len(parts) > 1 else DICTIONARY}"
    if not hasattr(cv2.aruco, name):
        raise NoBoard(f"--board {board}: OpenCV has no dictionary {name}; give e.g. 4X4_50")
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name))
    printed = cv2.aruco.CharucoBoard((columns, rows), 1.0, marker, dictionary)
    detector = cv2.aruco.CharucoDetector(printed)
    return lambda grey: _charuco(grey, printed, detector)


def _chessboard(grey: Picture, shape: tuple[int, int]) -> tuple[Corners, Corners] | None:
    """Find the corners of a chessboard on the board (N, 3) and in the picture (N, 2), by OpenCV's
    sector-based detector (Duda and Frese 2018); None without a board."""
    flags = cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_ACCURACY
    seen, corners = cv2.findChessboardCornersSB(grey, shape, flags=flags)
    if not seen:
        return None
    columns, rows = shape
    board = np.zeros((rows * columns, 3), np.float32)
    board[:, :2] = np.stack(np.meshgrid(np.arange(columns), np.arange(rows)), -1).reshape(-1, 2)
    return board, corners.reshape(-1, 2).astype(np.float32)


def _charuco(
    grey: Picture, printed: "cv2.aruco.CharucoBoard", detector: "cv2.aruco.CharucoDetector"
) -> tuple[Corners, Corners] | None:
    corners, ids, _, _ = detector.detectBoard(grey)
    if corners is None or ids is None or len(ids) < MIN_CHARUCO:
        return None
    board = np.asarray(printed.getChessboardCorners(), np.float32)[ids.ravel()]
    return board, corners.reshape(-1, 2).astype(np.float32)


@dataclass(frozen=True)
class _Solved:
    matrix: NDArray[np.float64]
    coefficients: NDArray[np.float64]
    error: float
    focal_std: float
    errors: dict[Path, float]
    projected: dict[Path, NDArray[np.float64]]


def _solve(
    found: dict[Path, tuple[Corners, Corners]], size: tuple[int, int], fisheye: bool
) -> _Solved:
    """Fit the lens to all corners by OpenCV's least squares. Raises NoBoard if it finds no lens."""
    solve, project = _fisheye if fisheye else _usual, _projection(fisheye)
    try:
        error, matrix, bent, turns, moves, focal_std = solve(list(found.values()), size)
    except cv2.error as problem:
        reason = " ".join(str(problem).split())
        raise NoBoard(
            f"OpenCV finds no lens for {len(found)} pictures ({reason}); take more, with the board "
            "turned to all sides and in all parts of the picture"
        ) from problem
    bent = np.ravel(bent)[: 4 if fisheye else 5]
    errors, projected = {}, {}
    for (path, (board, seen)), turn, move in zip(found.items(), turns, moves, strict=True):
        places = board.reshape(-1, 1, 3).astype(np.float64)
        at = np.asarray(project(places, turn, move, matrix, bent)[0], np.float64).reshape(-1, 2)
        projected[path] = at
        errors[path] = float(np.sqrt(((at - seen) ** 2).sum(axis=1).mean()))
    return _Solved(matrix, bent, error, focal_std, errors, projected)


def _projection(fisheye: bool) -> Callable[..., Any]:
    return cv2.fisheye.projectPoints if fisheye else cv2.projectPoints


def _usual(pairs: list[tuple[Corners, Corners]], size: tuple[int, int]) -> Any:
    """Fit a lens with OpenCV's usual distortion; returns error in px, camera matrix, coefficients,
    rotations and translations of the boards, and standard deviation of fy in px."""
    flags = cv2.CALIB_FIX_K3 if len(pairs) < FEW else 0
    boards, corners = ([pair[k] for pair in pairs] for k in range(2))
    *found, deviations, _, _ = cv2.calibrateCameraExtended(
        boards, corners, size, np.eye(3), np.zeros(5), flags=flags
    )
    return *found, float(np.ravel(deviations)[1])


def _fisheye(pairs: list[tuple[Corners, Corners]], size: tuple[int, int]) -> Any:
    """Fit a fisheye lens; returns the same values as `_usual`, but 0 for the standard deviation of
    fy, which OpenCV does not compute."""
    names: Any = cv2.fisheye if hasattr(cv2.fisheye, "CALIB_FIX_SKEW") else cv2  # OpenCV 4, 5
    found = cv2.fisheye.calibrate(
        [board.reshape(1, -1, 3).astype(np.float64) for board, _ in pairs],
        [corners.reshape(1, -1, 2).astype(np.float64) for _, corners in pairs],
        size,
        np.eye(3),
        np.zeros(4),
        flags=names.CALIB_RECOMPUTE_EXTRINSIC | names.CALIB_FIX_SKEW,
    )
    return *found, 0.0


def _outliers(errors: dict[Path, float]) -> dict[Path, float]:
    limit = max(1.0, OUTLIER * float(np.median(list(errors.values()))))
    return {path: error for path, error in errors.items() if error > limit}
