"""Converts TORCS segments to pieces: profile steps, spirals, heights, banking, as in TORCS 1.3.7.

All values are in SI units and at the centre line. The attributes have TORCS's names (`profil`).
Attributes that TORCS does not know, for example misspelt ones, have no effect.
"""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from simulator.track.errors import TrackError
from simulator.track.pieces import Piece
from simulator.track.torcs.torcs_xml import Section

MAX_LENGTH_M: Final = 100_000.0
MAX_ARC: Final = 4.0 * math.pi
MAX_STEPS: Final = 100_000


Edges = NDArray[np.float64]
"""Values (2,) for the left and the right edge of the road: heights (m) or slopes (dz/ds)."""


@dataclass
class Profile:
    """Values that a segment passes to the next segment: heights (m) and slopes (dz/ds) of both
    edges at the segment's end, and the grade (dz/ds), which holds until a segment sets another
    grade."""

    end: Edges
    tangent: Edges
    grade: float | None = None


def read_pieces(segments: Section, main: Section, width: float) -> Iterator[Piece]:
    """Yield the pieces of all segments in the section `segments`, in order. Each segment is cut
    into TORCS's profile steps. `main` is the section "Main Track", `width` (m) the track's
    width."""
    global_step = main.length("profil steps length") or 0.0
    profile = Profile(end=np.zeros(2), tangent=np.zeros(2))
    for segment in segments.sections():
        if segment.text("type") is not None:
            yield from _segment_pieces(segment, profile, width, global_step)


def _segment_pieces(
    segment: Section, profile: Profile, width: float, global_step: float
) -> Iterator[Piece]:
    """Yield the pieces of one segment, and store the heights and slopes at its end in `profile`.
    `width` (m) is the track's width, `global_step` (m) the track's default length of a profile
    step."""
    sign, radius, radius_end, length = _plan(segment)
    start, end = _end_heights(segment, profile, width, length)
    spline = (segment.text("profil") or "spline") == "spline"
    steps = _step_count(segment, length, global_step) if spline else 1
    tangents = _tangents(segment, profile, start, end, length, spline)
    arc = 0.0 if sign == 0 else length / ((radius + radius_end) / 2.0)
    lengths, radii = _steps(steps, length, radius, radius_end, arc)
    z0 = start
    for i in range(steps):
        t = (i + 1) / steps
        z1 = _hermite(start, end, tangents, length, t)
        yield Piece(lengths[i], sign / radii[i] if sign else 0.0, *z0.tolist(), *z1.tolist())
        z0 = z1
    profile.end, profile.tangent = end, tangents[1]


def _plan(segment: Section) -> tuple[int, float, float, float]:
    """Return turning sign (1 left, 0 straight, -1 right), start and end radius, and length (m)."""
    kind = segment.text("type")
    if kind == "str":
        length = segment.length("lg") or 0.0
        _check_length(segment, "lg", length)
        return 0, math.inf, math.inf, length
    if kind not in ("lft", "rgt"):
        raise TrackError(
            f"{segment.file}: segment {segment.name!r} has the type {kind!r}, "
            "expected str, lft or rgt"
        )
    radius = segment.length("radius") or 0.0
    radius_end = segment.length("end radius")
    radius_end = radius if radius_end is None else radius_end
    arc = segment.number("arc") or 0.0
    for name, value in (("radius", radius), ("end radius", radius_end), ("arc", arc)):
        _check_length(segment, name, value)
    if arc > MAX_ARC:
        raise TrackError(
            f"{segment.file}: segment {segment.name!r} turns by {math.degrees(arc):g} deg, "
            f"expected at most {math.degrees(MAX_ARC):g}"
        )
    length = (radius + radius_end) / 2.0 * arc
    _check_length(segment, "length", length)
    return (1 if kind == "lft" else -1), radius, radius_end, length


def _check_length(segment: Section, name: str, value: float) -> None:
    if not 0.0 < value <= MAX_LENGTH_M:
        raise TrackError(
            f"{segment.file}: segment {segment.name!r} has the {name} {value:g}, "
            f"expected more than 0 and at most {MAX_LENGTH_M:g}"
        )


def _end_heights(
    segment: Section, profile: Profile, width: float, length: float
) -> tuple[Edges, Edges]:
    """Return the heights (m) of both edges at the start and at the end of a segment of `length` m.
    `profile` contains the end of the previous segment; its grade is replaced if the segment sets
    one."""
    start = _edges(segment.length, "z start", profile.end)
    end = _edges(segment.length, "z end", profile.end)
    grade = segment.number("grade")
    if grade is not None:
        profile.grade = grade
    middle_start, middle_end = _mean(start), _mean(end)
    if segment.length("z end") is None and profile.grade is not None:
        middle_end = middle_start + length * profile.grade
    return (
        _banked(middle_start, start, segment.number("banking start"), width),
        _banked(middle_end, end, segment.number("banking end"), width),
    )


def _edges(read: Callable[[str], float | None], name: str, default: Edges) -> Edges:
    """Return the attribute `name` of both edges. It is set for both edges together, or separately
    for the left and the right edge; an edge for which it is not set has the value of `default`.
    `read` returns an attribute by its name, or None."""
    left, right = (read(f"{name} {side}") for side in ("left", "right"))
    both = read(name)
    if both is not None:
        return np.array([both, both])
    return np.array([_or(left, default[0]), _or(right, default[1])])


def _mean(edges: Edges) -> float:
    return float((edges[0] + edges[1]) / 2.0)


def _banked(middle: float, edges: Edges, banking: float | None, width: float) -> Edges:
    """Return both edges' heights (m) from the height `middle` (m) of the road's middle and the
    `banking` (rad). If `banking` is None, the height difference of `edges` (m) is used. `width` (m)
    is the track's width."""
    # Without a banking angle of its own, a segment keeps the height difference of its edges.
    half = (edges[0] - edges[1]) / 2.0 if banking is None else math.tan(banking) * width / 2.0
    return np.array([middle + half, middle - half])


def _step_count(segment: Section, length: float, global_step: float) -> int:
    """Return the number of profile steps of a segment of `length` m. `global_step` (m) is the
    track's default length of a step. Raises TrackError if the number is out of range."""
    steps = int(_or(segment.number("profil steps"), 1.0))
    if steps == 1:
        step_length = _or(segment.length("profil steps length"), global_step)
        if step_length > 0.0:
            steps = int(min(length / step_length, MAX_STEPS)) + 1
    if not 1 <= steps <= MAX_STEPS:
        raise TrackError(
            f"{segment.file}: segment {segment.name!r} has {steps} profile steps, "
            f"expected 1 to {MAX_STEPS}"
        )
    return steps


def _tangents(
    segment: Section, profile: Profile, start: Edges, end: Edges, length: float, spline: bool
) -> tuple[Edges, Edges]:
    """Return the slopes (dz/ds) of both edges at the start and at the end of a segment of `length`
    m. `start` and `end` are the heights (m) of the edges; without `spline` the slopes are constant
    between them. With `spline`, slopes that the segment does not set are the slopes at the end of
    the previous segment, from `profile`."""
    if not spline:
        chord: Edges = (end - start) / length
        return chord, chord
    previous = profile.tangent
    return (
        _edges(segment.number, "profil start tangent", previous),
        _edges(segment.number, "profil end tangent", previous),
    )


def _steps(
    steps: int, length: float, radius: float, radius_end: float, arc: float
) -> tuple[list[float], list[float]]:
    """Return length and radius (m) of each of `steps` steps of a segment of `length` m, whose
    radius changes from `radius` to `radius_end` (m). The steps of a spiral turn by `arc` rad in
    total."""
    step = length / steps
    if radius == radius_end or steps == 1:
        # A single step has only the start radius, so its length follows from the arc.
        only = step if radius == radius_end else radius * arc
        return [only] * steps, [radius] * steps
    change = (radius_end - radius) / (steps - 1)
    radii = [radius + i * change for i in range(steps)]
    step *= arc / sum(step / r for r in radii)
    return [step] * steps, radii


def _hermite(
    start: Edges, end: Edges, tangents: tuple[Edges, Edges], length: float, t: float
) -> Edges:
    """Return the heights (m) of both edges at the share `t` (0 to 1) of a segment of `length` m.
    They follow a cubic with the heights `start` and `end` (m) and the slopes `tangents` at both
    ends."""
    if t == 1.0:
        return end
    h_end = t * t * (3.0 - 2.0 * t)
    h_t0 = t * (1.0 - t) ** 2 * length
    h_t1 = t * t * (t - 1.0) * length
    first, last = tangents
    height: Edges = start + (end - start) * h_end + first * h_t0 + last * h_t1
    return height


def _or(value: float | None, default: float) -> float:
    return default if value is None else value
