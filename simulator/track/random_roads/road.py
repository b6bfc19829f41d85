"""Random roads: the track `random:SEED`, which its seed determines.

The network's angle has its largest errors, and a bias, in tight bends and at changes of curvature.
Few frames of other tracks show these places; on random roads half of the frames show them.

The road is generated as the content of a TOML file (see `toml_track`), in decimals. The same seed
gives the same decimals on every machine: the random numbers are those of numpy's PCG64, and
rounding removes the differences of sines in the last bits. The hash of the track is the hash of
these decimals.
"""

import json
import math
import re
from collections.abc import Iterator, Mapping
from dataclasses import asdict
from functools import lru_cache
from pathlib import Path
from typing import Any, Final

import numpy as np

from runtime.files import atomic_write
from simulator.arrays import FloatArray
from simulator.track.errors import UnknownTrack
from simulator.track.geometry import Track
from simulator.track.layout import Segment, cut, place, segment_length
from simulator.track.random_roads.clearance import keeps_clear
from simulator.track.random_roads.course import Course, DoesNotFit, draw_course
from simulator.track.random_roads.kinds import Kind, kind_of
from simulator.track.toml_track import Table, build_track, read_segments

RANDOM: Final = "random"
MAX_SEED: Final = 2**63 - 1
CALMER: Final = 0.98
"""Factor by which the unevenness of the course is reduced after each random course that does not
fit, so that finally a course fits."""
DASHES: Final = ((3.0, 6.0), (4.0, 8.0), (6.0, 12.0), (3.0, 9.0))
Row = dict[str, Any]
_SEED: Final = re.compile(r"[0-9]{1,19}")


def is_random(name: str) -> bool:
    """Return whether `name` has the form of a random road's name, even if it is misspelt."""
    return name == RANDOM or name.startswith(f"{RANDOM}:")


def random_name(seed: int) -> str:
    """Return the name of the road of `seed`."""
    return f"{RANDOM}:{seed}"


@lru_cache(maxsize=1024)  # a plan needs each track twice; a track takes 70 kB
def random_track(name: str) -> Track:
    """Build the track called `random:SEED`. Raises UnknownTrack for any other name."""
    seed = seed_of(name)
    return build_track(Table(road_file(seed), name), random_name(seed))


def seed_of(name: str) -> int:
    """Return SEED of `random:SEED`. Raises UnknownTrack for any other name."""
    seed = name.removeprefix(f"{RANDOM}:")
    if not _SEED.fullmatch(seed) or int(seed) > MAX_SEED:
        raise UnknownTrack(
            f"{name!r} names no random road; give random:SEED with a whole number from 0 to "
            "2^63 - 1, e.g. random:7 (`datagen collect` takes random alone: each round its own "
            "road)"
        )
    return int(seed)


def road_file(seed: int) -> dict[str, Any]:
    """Return the content of the TOML file of the road of `seed`."""
    kind = kind_of(seed)
    rng = np.random.default_rng([seed, 0])
    about = _about(kind, rng)
    rows = _course_rows(kind, rng)
    for row, grade in zip(rows, _grades(kind, _read(rows), rng), strict=True):
        row["grade"] = grade
    return {**about, "hash": "segments", "segment": rows}


def _about(kind: Kind, rng: np.random.Generator) -> dict[str, Any]:
    """Return random entries of the file other than the segments: look, surface, paint."""
    gravel = bool(rng.uniform() < kind.gravel)
    look = "gravel" if gravel else kind.looks[rng.integers(len(kind.looks))]
    surface = "gravel" if gravel else "concrete" if rng.uniform() < 0.1 else "asphalt"
    dash_length, dash_gap = DASHES[rng.integers(len(DASHES))]
    return {
        "look": look,
        "surface": surface,
        "width": _decimal(kind.width_m, 1, rng),
        "vertical_curve": _decimal(kind.vertical_curve_m, 0, rng),
        "markings": {
            "line_width": _decimal((0.11, 0.15), 2, rng),
            "dash_length": dash_length,
            "dash_gap": dash_gap,
            "left_colour": "yellow" if rng.uniform() < 0.25 else "white",
            "kerbs": bool(rng.uniform() < kind.kerbs) and not gravel,
            "wear": _decimal(kind.wear, 2, rng),
        },
    }


def _decimal(limits: tuple[float, float], digits: int, rng: np.random.Generator) -> float:
    return round(float(rng.uniform(*limits)), digits)


def _course_rows(kind: Kind, rng: np.random.Generator) -> list[Row]:
    """Return the TOML rows, without grades, of a random course that keeps clear of itself."""
    unevenness = kind.unevenness
    while True:
        try:
            rows = _rows(draw_course(kind, unevenness, rng))
        except DoesNotFit:
            pass
        else:
            if keeps_clear(_read(rows)):
                return rows
        unevenness *= CALMER


def _rows(course: Course) -> list[Row]:
    """Return the TOML rows of a lap of `course` that starts and ends in the middle of the first
    straight."""
    half = round(course.straights[0] / 2.0, 3)
    rows: list[Row] = []
    for length, corner in zip((half, *course.straights[1:]), course.corners, strict=True):
        rows.append({"type": "straight", "length": length})
        rows += [{"type": "bend", **asdict(arc)} for arc in corner]
    return [*rows, {"type": "straight", "length": round(course.straights[0] - half, 3)}]


def _read(rows: list[Row]) -> list[Segment]:
    return read_segments(Table({"segment": rows}, RANDOM))


def _grades(kind: Kind, segments: list[Segment], rng: np.random.Generator) -> list[float]:
    """Return the grade of each of `segments` in percent. The road lies on hills, so that
    neighbouring parts have similar heights and the lap closes in height."""
    placed = place(cut(segments))
    lengths = np.array([segment_length(segment) for segment in segments])
    at = np.concatenate(([0.0], np.cumsum(lengths)))[:-1]
    first = np.searchsorted(placed.s0, at + 1e-6, side="right") - 1
    height = _hills(kind, placed.x0[first], placed.y0[first], rng)
    grades = (np.roll(height, -1) - height) / lengths
    steepest = float(rng.uniform(*kind.grade_percent))
    grades = grades * (steepest / np.abs(grades).max())
    return [round(float(grade), 2) for grade in grades]


def _hills(kind: Kind, x: FloatArray, y: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Return heights (n,) at (x, y): the sum of three waves of slope 1 in random directions."""
    height = np.zeros(len(x))
    for _ in range(3):
        wave = 2.0 * math.pi / float(rng.uniform(*kind.hill_m))
        direction, phase = rng.uniform(0.0, 2.0 * math.pi, 2).tolist()
        along = x * math.cos(direction) + y * math.sin(direction)
        height = height + np.sin(along * wave + phase) / wave
    return height


def write_road(seed: int, path: Path) -> None:
    """Write the road of `seed` as a TOML file that reads back as the same track (see `toml_track`).
    Raises UserError if the folder is missing, OSError if the disk is full."""
    comment = f"# {random_name(seed)}: a random road of the kind {kind_of(seed).name}."
    atomic_write(path, "\n".join([comment, *_lines(road_file(seed))]) + "\n")


def _lines(content: Mapping[str, Any]) -> Iterator[str]:
    """Yield the lines of a TOML file; strings, booleans and numbers are written as in JSON."""
    for key, value in content.items():
        if not isinstance(value, dict | list):
            yield f"{key} = {json.dumps(value)}"
    for key, value in content.items():
        tables = value if isinstance(value, list) else [value] if isinstance(value, dict) else []
        for table in tables:
            yield from ("", f"[[{key}]]" if isinstance(value, list) else f"[{key}]")
            yield from (f"{name} = {json.dumps(entry)}" for name, entry in table.items())
