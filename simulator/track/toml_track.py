"""Reads the project's own track format, a TOML list of straights and bends.

    look, surface, width (m), vertical_curve (m, at most the lap)
    [markings]   the fields of `MarkingStyle`
    [[segment]]  type = "straight", length (m)
    [[segment]]  type = "bend", radius (m), angle (deg, left positive, spirals included),
                 spiral (m, each end), banking (deg, outer edge up)
    grade (%, uphill positive) of a segment holds until a later segment sets another one.
    hash         "segments": the track's hash is computed from the numbers in the file, which are
                 the same on every machine; "geometry" (default): from the pieces computed from
                 these numbers

The bends must turn by +-360 degrees in total, or by 0 on a figure of eight. Straights are adjusted
by up to a metre so that the loop closes exactly. The mean grade is subtracted so that the heights
close too.
"""

import hashlib
import math
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, Final, cast, get_args

import numpy as np

from simulator.track.errors import TrackError
from simulator.track.geometry import Surface, Track, readable_name
from simulator.track.layout import Bend, Segment, Straight, close, lay, segment_length
from simulator.track.markings import LineColour, MarkingStyle
from simulator.track.pieces import assemble, check_closes, check_turn

MAX_BYTES: Final = 2**20
MAX_CORRECTION_M: Final = 1.0
"""Largest change of a straight to close the loop; a larger change would give a different road."""
MAX_GAP_M: Final = 1e-3
LOOKS: Final = (
    "highway",
    "ring-road",
    "mountain",
    "circuit",
    "oval",
    "town",
    "forest",
    "coast",
    "gravel",
    "countryside",
)


@dataclass(frozen=True)
class Table:
    """A TOML table with its position in the file, which error messages contain."""

    values: Mapping[str, Any]
    where: str

    def number(self, key: str, lo: float, hi: float, default: float | None = None) -> float:
        """Return the number `key`, or `default` if there is no `key`. Raises TrackError unless the
        result is a number from `lo` to `hi`."""
        value = self.values.get(key, default)
        if isinstance(value, bool) or not isinstance(value, int | float) or not lo <= value <= hi:
            raise TrackError(
                f"{self.where}: {key} is {value!r}, expected a number from {lo:g} to {hi:g}"
            )
        return float(value)

    def choice(self, key: str, choices: tuple[str, ...], default: str | None = None) -> str:
        """Return the text `key`, or `default` if there is no `key`. Raises TrackError unless the
        result is one of `choices`."""
        value = self.values.get(key, default)
        if value not in choices:
            raise TrackError(f"{self.where}: {key} is {value!r}, expected one of {choices}")
        return str(value)

    def only(self, *keys: str) -> None:
        """Raises TrackError if the table has a key that is not in `keys`, because a misspelt key
        would have no effect."""
        for key in self.values:
            if key not in keys:
                raise TrackError(f"{self.where}: unknown key {key!r}, expected {', '.join(keys)}")


def read_toml_track(path: Path) -> Track:
    """Read the track of one TOML file, named after the file. Raises TrackError if it is bad."""
    try:
        return build_track(Table(_load(path), str(path)), readable_name(path.stem))
    except ValueError as error:  # a message with an integer of thousands of hexadecimal digits
        raise TrackError(f"{path}: {error}") from None


def build_track(table: Table, name: str) -> Track:
    """Build the track that a TOML file's content describes. Raises TrackError if it is bad."""
    table.only("look", "surface", "width", "vertical_curve", "hash", "markings", "segment")
    width = table.number("width", 6.0, 40.0)
    vertical_curve = table.number("vertical_curve", 1.0, 200.0, 50.0)
    written = read_segments(table)
    closed = _closed(written, table.where)
    lap = sum(map(segment_length, closed))
    if vertical_curve > lap:
        raise TrackError(
            f"{table.where}: vertical_curve {vertical_curve:g} m is longer than the lap of "
            f"{lap:.1f} m; give less"
        )
    placed = assemble(lay(closed, width, vertical_curve))
    check_closes(placed, table.where, MAX_GAP_M)
    hashed = table.choice("hash", ("geometry", "segments"), "geometry")
    markings = Table(table.values.get("markings", {}), f"{table.where}: [markings]")
    return Track.from_placed(
        placed,
        name=name,
        source="own",
        width=width,
        surface=cast(Surface, table.choice("surface", get_args(Surface), "asphalt")),
        look=table.choice("look", LOOKS),
        markings=_markings(markings),
        definition_hash=_hash(written, width, vertical_curve) if hashed == "segments" else "",
    )


def _hash(written: list[Segment], width: float, vertical_curve: float) -> str:
    """Return the SHA-256 (hex) of the numbers of a definition: the segments as `written`, the
    `width` (m) and `vertical_curve` (m).

    The computed geometry differs by 1e-12 m between machines, because their libraries round sines
    differently. Parsed decimals and their products do not differ.
    """
    rows = [
        (segment.length, 0.0, 0.0, 0.0, segment.grade)
        if isinstance(segment, Straight)
        else (segment.radius, segment.angle, segment.spiral, segment.banking, segment.grade)
        for segment in written
    ]
    numbers = np.array([(width, vertical_curve, 0.0, 0.0, 0.0), *rows], dtype="<f8")
    return hashlib.sha256(b"segments 1" + numbers.tobytes()).hexdigest()


def _closed(written: list[Segment], where: str) -> list[Segment]:
    """Close the loop of the segments `written` in the file. Raises TrackError, which contains
    `where`, if this changes a straight too much."""
    check_turn(sum(s.angle for s in written if isinstance(s, Bend)), where)
    try:
        segments, correction = close(written)
    except TrackError as error:
        raise TrackError(f"{where}: {error}") from None
    if correction > MAX_CORRECTION_M:
        raise TrackError(
            f"{where}: to close the loop a straight would have to change by {correction:.2f} m, "
            f"allowed are {MAX_CORRECTION_M:g} m; correct the lengths or angles"
        )
    if any(isinstance(s, Straight) and s.length <= 0.0 for s in segments):
        raise TrackError(f"{where}: closing the loop leaves a straight no length; lengthen it")
    return segments


def read_segments(table: Table) -> list[Segment]:
    """Return the segments as written, before the loop is closed. A segment without a grade has the
    grade of the segment before it; the first has 0."""
    rows = table.values.get("segment")
    if not isinstance(rows, list) or not 3 <= len(rows) <= 1000:
        raise TrackError(f"{table.where}: expected 3 to 1000 [[segment]] tables")
    segments: list[Segment] = []
    grade = 0.0
    for number, row in enumerate(rows, start=1):
        if not isinstance(row, Mapping):
            raise TrackError(f"{table.where}: segment {number} is no table")
        entry = Table(row, f"{table.where}: segment {number}")
        grade = entry.number("grade", -30.0, 30.0, grade)
        if entry.choice("type", ("straight", "bend")) == "straight":
            entry.only("type", "length", "grade")
            segments.append(Straight(entry.number("length", 0.1, 10_000.0), grade / 100.0))
        else:
            segments.append(_bend(entry, grade / 100.0))
    return segments


def _bend(entry: Table, grade: float) -> Bend:
    """Read a bend with the slope `grade` (dz/ds) from its table. Raises TrackError if its spirals
    do not fit."""
    entry.only("type", "radius", "angle", "spiral", "banking", "grade")
    radius = entry.number("radius", 8.0, 10_000.0)
    angle = math.radians(entry.number("angle", -360.0, 360.0))
    spiral = entry.number("spiral", 0.0, 500.0, 0.0)
    banking = math.radians(entry.number("banking", -5.0, 30.0, 0.0))
    if angle == 0.0 or abs(angle) * radius < spiral:
        raise TrackError(
            f"{entry.where}: spirals of {spiral:g} m do not fit into a bend of "
            f"{math.degrees(angle):g} deg with radius {radius:g} m; shorten them"
        )
    if banking != 0.0 and spiral == 0.0:
        raise TrackError(f"{entry.where}: a banked bend needs a spiral to lean into; give one")
    return Bend(radius, angle, spiral, banking, grade)


def _load(path: Path) -> Mapping[str, Any]:
    """Read a TOML file. Raises TrackError if it is too large or unreadable."""
    size = path.stat().st_size
    if size > MAX_BYTES:
        raise TrackError(f"{path}: {size} bytes; a track file has at most {MAX_BYTES}")
    try:
        return tomllib.loads(path.read_bytes().decode("utf-8"))
    except (ValueError, RecursionError) as error:
        # ValueError, because Python itself refuses an integer of thousands of digits.
        raise TrackError(f"{path}: not a readable TOML file ({error})") from None


def _markings(table: Table) -> MarkingStyle:
    """Read the style of the markings from the table [markings]."""
    if not isinstance(table.values, Mapping):
        raise TrackError(f"{table.where}: expected a table")
    table.only(*(field.name for field in fields(MarkingStyle)))
    plain = MarkingStyle()
    kerbs = table.values.get("kerbs", plain.kerbs)
    if not isinstance(kerbs, bool):
        raise TrackError(f"{table.where}: kerbs is {kerbs!r}, expected true or false")
    colour = table.choice("left_colour", get_args(LineColour), plain.left_colour)
    return MarkingStyle(
        line_width=table.number("line_width", 0.11, 0.15, plain.line_width),
        dash_length=table.number("dash_length", 1.0, 20.0, plain.dash_length),
        dash_gap=table.number("dash_gap", 1.0, 20.0, plain.dash_gap),
        left_colour=cast(LineColour, colour),
        kerbs=kerbs,
        wear=table.number("wear", 0.0, 1.0, plain.wear),
    )
