"""Reads and writes centre lines as CSV files.

It reads the format of the TUM racetrack database, `x_m,y_m,w_tr_right_m,w_tr_left_m` (metres, one
point per row, closed, no heights). It writes `s,x,y,z,ang,curv` (m, rad, 1/m) of any track.
"""

import math
from pathlib import Path
from typing import Final

import numpy as np
from scipy.interpolate import splev, splprep

from runtime.files import atomic_write
from simulator.arrays import FloatArray
from simulator.track.errors import TrackError
from simulator.track.geometry import Track, readable_name
from simulator.track.markings import imported_style
from simulator.track.pieces import Piece, Placed, assemble, check_closes
from trackfeatures.errors import UserError

MAX_BYTES: Final = 16 * 2**20
POINTS: Final = (8, 100_000)
LENGTH_M: Final = (50.0, 100_000.0)
WIDTH_M: Final = (2.0, 60.0)
FARTHEST_M: Final = 1e7
"""Largest coordinate of a map; it is the largest northing of UTM."""
LOCAL_M: Final = 1e4
"""Points farther from the origin are moved to the origin by a multiple of 1 km. Graphics and
contacts compute in float32, whose spacing is 0.5 m at the northings of UTM."""
STEP_LIMITS_M: Final = (0.01, 1000.0)

PIECE_M: Final = 4.0
"""Approximate length (m) of a piece of the track."""
NOISE_M: Final = (0.05, 1.0)
"""Least and greatest noise (m, RMS) of the points that the smoothing assumes. Between these bounds
the noise is estimated from the points."""
SMOOTHER: Final = 1.2
"""Factor on the variance of the noise that the smoothing removes. It is above 1, because too much
smoothing still gives a road, but too little smoothing gives a wavy road."""
MIN_RADIUS_M: Final = 5.0
"""A centre line with a smaller radius (m) is an error of the survey, not a road."""
MAX_GAP_M: Final = 1e-3
HEADER: Final = "s,x,y,z,ang,curv\n"
ROW: Final = "%.6f,%.6f,%.6f,%.6f,%.9f,%.9f\n"


def read_centre_line(path: Path) -> Track:
    """Read a flat track along the points of a CSV file. The track's width is the median of the
    widths at the points. A track farther than 10 km (LOCAL_M) from the origin is moved to it.

    Raises TrackError for a file that is not of this format, or if its points are no closed road.
    """
    points, width = _read_points(path)
    placed = _arcs(points, path)
    check_closes(placed, str(path), MAX_GAP_M)
    radius = 1.0 / float(np.max(np.abs(placed.curvature)))
    if radius < MIN_RADIUS_M:
        raise TrackError(
            f"{path}: the line bends with a radius of {radius:.1f} m, expected at least "
            f"{MIN_RADIUS_M:g} m; are the points in order and in metres?"
        )
    return Track.from_placed(
        placed,
        name=readable_name(path.stem),
        source="csv",
        width=width,
        surface="asphalt",
        look="circuit",
        markings=imported_style(readable_name(path.stem), kerbs=True),
    )


def _read_points(path: Path) -> tuple[FloatArray, float]:
    """Return the points (N, 2) of the closed line, each once, and the track's width (m)."""
    rows = _read_rows(path)
    widths = rows[:, 2] + rows[:, 3]
    if not (rows[:, 2:] > 0.0).all():
        raise TrackError(
            f"{path}: a width to one side of the centre line is {rows[:, 2:].min():g} m; "
            "the widths to both sides must be above 0"
        )
    if not WIDTH_M[0] <= float(np.median(widths)) <= WIDTH_M[1]:
        raise TrackError(
            f"{path}: widths from {widths.min():g} to {widths.max():g} m, "
            f"expected {WIDTH_M[0]:g} to {WIDTH_M[1]:g} m"
        )
    points = rows[:, :2]
    apart = np.hypot(*(np.roll(points, -1, axis=0) - points).T)
    # Files often repeat the first point as the last one.
    points, apart = points[apart > 1e-6], apart[apart > 1e-6]
    if not LENGTH_M[0] <= float(apart.sum()) <= LENGTH_M[1] or len(points) < POINTS[0]:
        raise TrackError(
            f"{path}: {len(points)} different points round {apart.sum():.1f} m, expected at least "
            f"{POINTS[0]} points and {LENGTH_M[0]:g} to {LENGTH_M[1]:g} m"
        )
    if apart[-1] > 10.0 * float(np.median(apart)):
        raise TrackError(
            f"{path}: the last point is {apart[-1]:.1f} m from the first; "
            "a track must be one closed loop"
        )
    return points - _far_origin(points), float(np.median(widths))


def _far_origin(points: FloatArray) -> FloatArray:
    """Return the middle of the points (N, 2), rounded to 1 km, as (2,) m; 0 if all points are
    within 10 km of the origin."""
    if np.abs(points).max() <= LOCAL_M:
        return np.zeros(2)
    return np.asarray(np.round((points.min(axis=0) + points.max(axis=0)) / 2000.0) * 1000.0)


def _read_rows(path: Path) -> FloatArray:
    """Read the rows (N, 4) of the CSV file. Raises TrackError for a line of another format."""
    size = path.stat().st_size
    if size > MAX_BYTES:
        raise TrackError(f"{path}: {size} bytes; a centre-line file has at most {MAX_BYTES}")
    try:
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    except UnicodeDecodeError as error:
        raise TrackError(f"{path}: not a text file ({error})") from None
    rows: list[list[float]] = []
    for number, line in enumerate(lines, start=1):
        text = line.strip()
        if not text or text.startswith("#") or (number == 1 and text.startswith("x_m")):
            continue
        try:
            row = [float(cell) for cell in text.replace(";", ",").split(",")]
        except ValueError:
            row = []
        if len(row) != 4 or not all(math.isfinite(value) for value in row):
            raise TrackError(
                f"{path}: line {number} is {text[:60]!r}, expected four finite numbers: "
                "x_m,y_m,w_tr_right_m,w_tr_left_m"
            )
        if max(abs(row[0]), abs(row[1])) > FARTHEST_M:
            raise TrackError(
                f"{path}: line {number} is {text[:60]!r}, a point more than {FARTHEST_M:g} m "
                "from the origin; coordinates are metres"
            )
        rows.append(row)
    if not POINTS[0] <= len(rows) <= POINTS[1]:
        raise TrackError(f"{path}: {len(rows)} points, expected {POINTS[0]} to {POINTS[1]}")
    return np.array(rows, dtype=np.float64)


def _arcs(points: FloatArray, path: Path) -> Placed:
    """Return arcs along a periodic smoothing spline through the points, in their coordinates."""
    closed = np.vstack((points, points[:1]))
    noise = min(max(survey_noise(points), NOISE_M[0]), NOISE_M[1])
    tck, _ = splprep(closed.T, s=SMOOTHER * len(points) * noise**2, per=1)
    fine = np.linspace(0.0, 1.0, max(20 * len(points), 2000) + 1)
    x, y = splev(fine, tck)
    dx, dy = splev(fine, tck, der=1)
    s = np.concatenate(([0.0], np.cumsum(np.hypot(np.diff(x), np.diff(y)))))
    heading = np.unwrap(np.arctan2(dy, dx))
    count = max(8, round(float(s[-1]) / PIECE_M))
    nodes = np.linspace(0.0, float(s[-1]), count + 1)
    turn = np.diff(np.interp(nodes, s, heading))
    if abs(math.remainder(float(turn.sum()), 2.0 * math.pi)) > 1e-6:
        raise TrackError(f"{path}: the points do not run round a closed loop")
    length = _closing_lengths(np.full(count, s[-1] / count), turn, float(heading[0]))
    pieces = [Piece(float(ds), float(dh / ds)) for ds, dh in zip(length, turn, strict=True)]
    return assemble(pieces, float(x[0]), float(y[0]), float(heading[0]))


def survey_noise(points: FloatArray) -> float:
    """Estimate the standard deviation (m) of the lateral noise of points (N, 2) along a smooth
    closed line.

    Each point is compared with the cubic through the two points before it and the two points after
    it, as a function of the chord length. The median ignores the few joints where a bend begins
    abruptly.
    """
    before2, before, after, after2 = (np.roll(points, k, axis=0) for k in (2, 1, -1, -2))
    chord = np.hypot(*(after - points).T)
    t = np.stack(
        (
            -np.roll(chord, 1) - np.roll(chord, 2),
            -np.roll(chord, 1),
            chord,
            chord + np.roll(chord, -1),
        )
    )
    weights = np.stack(
        [np.prod([t[j] / (t[j] - t[i]) for j in range(4) if j != i], axis=0) for i in range(4)]
    )
    neighbours = np.stack((before2, before, after, after2))
    error = points - np.einsum("in,inj->nj", weights, neighbours)
    along = after - before
    sideways = (along[:, 0] * error[:, 1] - along[:, 1] * error[:, 0]) / np.hypot(*along.T)
    # The deviation contains the errors of the point and of its four neighbours.
    sideways /= np.sqrt(1.0 + np.sum(weights**2, axis=0))
    return float(np.median(np.abs(sideways)) / 0.6745)


def _closing_lengths(length: FloatArray, turn: FloatArray, heading: float) -> FloatArray:
    """Change the lengths (n,) of arcs as little as possible, so that the end of the last arc meets
    the start of the first; return the new lengths (m). Arc i turns by `turn[i]` (rad), which stays
    constant; the first arc starts in the direction `heading` (rad)."""
    middle = heading + np.concatenate(([0.0], np.cumsum(turn)[:-1])) + turn / 2.0
    chord = np.sinc(turn / (2.0 * np.pi)) * np.stack((np.cos(middle), np.sin(middle)))
    gap = chord @ length
    closed: FloatArray = length - chord.T @ np.linalg.solve(chord @ chord.T, gap)
    return closed


def write_centre_line(track: Track, step: float, path: Path) -> int:
    """Write `s,x,y,z,ang,curv` of one lap, a row every `step` m; returns the number of rows.

    An existing file is replaced only when the new one is complete.
    """
    if not STEP_LIMITS_M[0] <= step <= STEP_LIMITS_M[1]:
        raise UserError(f"step {step:g} m asked for; it must be {STEP_LIMITS_M[0]:g} to 1000 m")
    s = np.arange(0.0, track.length_m, step)
    pose = track.at(s)
    rows = np.column_stack((s, pose.x, pose.y, pose.z, pose.heading, pose.curvature))
    atomic_write(path, HEADER + "".join(ROW % tuple(row) for row in rows))
    return len(s)
