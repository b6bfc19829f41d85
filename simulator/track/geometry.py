"""A track: a closed centre line of pieces with constant curvature, with the heights of both edges.

World frame: x, y in the plane, z up, metres. s is the distance along the centre line in driving
direction, y and to_middle are offsets to the left, in metres. Headings are in rad,
counter-clockwise.
"""

import hashlib
import json
import re
from dataclasses import asdict, dataclass, fields, replace
from functools import cached_property
from typing import Literal, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from simulator.arrays import FloatArray
from simulator.track import piece_table
from simulator.track.markings import MarkingStyle
from simulator.track.pieces import Placed

Source = Literal["own", "torcs", "csv"]
Surface = Literal["asphalt", "gravel", "concrete"]
_UNDECODABLE = re.compile(r"[\ud800-\udfff]")
"""Surrogate characters. Python decodes each byte of a file name that is not UTF-8 to one of
them."""


def readable_name(name: str) -> str:
    """Return the name of the track in the file `name`. Bytes that are not UTF-8 become U+FFFD,
    because names are drawn, recorded and sent as text."""
    return _UNDECODABLE.sub("\N{REPLACEMENT CHARACTER}", name)


@dataclass(frozen=True)
class TrackPose:
    """Points of the road plane as arrays of one shape: x, y, z in m, heading in (-pi, pi] rad,
    curvature of the centre line in 1/m."""

    x: FloatArray
    y: FloatArray
    z: FloatArray
    heading: FloatArray
    curvature: FloatArray


@dataclass(frozen=True, eq=False)
class Track:
    """One track. Its arrays (P,) have one entry per piece, in driving order. The last piece ends
    where the first begins (an imported track may have a gap of up to 0.28 m)."""

    name: str
    source: Source
    width: float
    """The track's own full width, m; a road on the track may be wider (see `road.Road`)."""
    surface: Surface
    look: str
    """Name of the scenery theme, such as "highway" or "forest"."""
    markings: MarkingStyle
    s0: FloatArray
    length: FloatArray
    x0: FloatArray
    y0: FloatArray
    heading0: FloatArray
    curvature0: FloatArray
    z_left0: FloatArray
    z_right0: FloatArray
    z_left1: FloatArray
    z_right1: FloatArray
    definition_hash: str = ""
    """Hash of the definition; if set, it replaces the hash of the computed geometry."""

    @classmethod
    def from_placed(
        cls,
        placed: Placed,
        *,
        name: str,
        source: Source,
        width: float,
        surface: Surface,
        look: str,
        markings: MarkingStyle,
        definition_hash: str = "",
    ) -> Self:
        """Build a track of `width` m from pieces placed end to end; `look` is the name of its
        scenery theme. A `definition_hash` replaces the hash of the geometry."""
        arrays = [getattr(placed, field.name) for field in fields(Placed) if field.name != "end"]
        track = cls(name, source, width, surface, look, markings, *arrays)
        return replace(track, definition_hash=definition_hash)

    @property
    def length_m(self) -> float:
        """Length of a lap along the centre line, m."""
        return float(self.s0[-1] + self.length[-1])

    @property
    def min_radius_m(self) -> float:
        """Smallest radius of the centre line, m; infinite if there is no bend."""
        sharpest = float(np.max(np.abs(self.curvature0)))
        return 1.0 / sharpest if sharpest > 0.0 else float("inf")

    @property
    def z_range_m(self) -> float:
        """Difference between highest and lowest point of the centre line, m."""
        heights = np.concatenate((self.z_left0 + self.z_right0, self.z_left1 + self.z_right1)) / 2
        return float(np.ptp(heights))

    @property
    def grade_range(self) -> tuple[float, float]:
        """Least and greatest slope dz/ds of the centre line in driving direction."""
        rise = (self.z_left1 + self.z_right1 - self.z_left0 - self.z_right0) / 2
        grade = rise / self.length
        return float(grade.min()), float(grade.max())

    @cached_property
    def content_hash(self) -> str:
        """`definition_hash` if it is set, otherwise the SHA-256 (hex) of the geometry. The hash
        does not depend on the track's name."""
        return (
            self.definition_hash
            or hashlib.sha256(
                self.arrays()[:, : piece_table.GEOMETRY].astype("<f8").tobytes()
            ).hexdigest()
        )

    @property
    def driving_hash(self) -> str:
        """`content_hash` and the surface, which together determine how a car drives."""
        return f"{self.content_hash} {self.surface}"

    @property
    def picture_hash(self) -> str:
        """SHA-256 (hex) of `driving_hash`, the scenery theme and the paint of the markings, which
        together determine how a car drives and what its camera sees."""
        seen = self.driving_hash, self.look, asdict(self.markings)
        return hashlib.sha256(json.dumps(seen, sort_keys=True).encode()).hexdigest()

    @cached_property
    def _table(self) -> FloatArray:
        table = np.empty((len(self.s0), piece_table.COLUMNS), dtype=np.float64)
        table[:, piece_table.S0] = self.s0
        table[:, piece_table.LENGTH] = self.length
        table[:, piece_table.X0] = self.x0
        table[:, piece_table.Y0] = self.y0
        table[:, piece_table.HEADING0] = self.heading0
        table[:, piece_table.CURVATURE] = self.curvature0
        table[:, piece_table.Z_LEFT0] = self.z_left0
        table[:, piece_table.Z_RIGHT0] = self.z_right0
        table[:, piece_table.Z_LEFT1] = self.z_left1
        table[:, piece_table.Z_RIGHT1] = self.z_right1
        table[:, piece_table.HALF_WIDTH] = self.width / 2
        table[:, piece_table.TRACK_LENGTH] = self.length_m
        piece_table.complete_table(table)
        return table

    def arrays(self) -> FloatArray:
        """Return the C-contiguous table (P, 16) that the functions of `piece_table` take."""
        return self._table

    def at(self, s: ArrayLike, y: ArrayLike = 0.0) -> TrackPose:
        """Return the points of the road plane at the distances `s` and the offsets `y` (m), which
        are broadcast to one shape; s wraps round the lap."""
        distance, offset = np.broadcast_arrays(
            np.asarray(s, dtype=np.float64), np.asarray(y, dtype=np.float64)
        )
        index, along = self._pieces_at(distance)
        k = self.curvature0[index]
        turn = k * along
        chord = along * np.sinc(turn / (2.0 * np.pi))
        direction = self.heading0[index] + turn / 2.0
        heading = self.heading0[index] + turn
        share = along / self.length[index]
        left = self.z_left0[index] + (self.z_left1 - self.z_left0)[index] * share
        right = self.z_right0[index] + (self.z_right1 - self.z_right0)[index] * share
        return TrackPose(
            x=self.x0[index] + chord * np.cos(direction) - offset * np.sin(heading),
            y=self.y0[index] + chord * np.sin(direction) + offset * np.cos(heading),
            z=(left + right) / 2.0 + (left - right) * offset / self.width,
            heading=wrap_angle(heading),
            curvature=k,
        )

    def project(self, x: float, y: float, hint_s: float | None = None) -> tuple[float, float]:
        """Return the track coordinates (s, to_middle) in m of a world point (m).

        Without `hint_s` the whole centre line is searched. With `hint_s`, the part near that s is
        searched first, which distinguishes a bridge from the road below it; the whole centre line
        is searched only if the point is not found there.
        """
        table = self.arrays()
        hint = -1 if hint_s is None else piece_table.index_at(table, float(hint_s))
        _, s, to_middle = piece_table.locate(table, float(x), float(y), hint)
        return float(s), float(to_middle)

    def heading(self, s: float) -> float:
        """Return the direction of the centre line's tangent at s, in the world frame, rad in (-pi,
        pi]."""
        _, _, _, heading, _ = piece_table.pose_at(self.arrays(), float(s))
        return float(wrap_angle(np.float64(heading)))

    def curvature(self, s: float) -> float:
        """Return the signed curvature (1/m, left positive) at s, which wraps. For arrays use
        `at`."""
        return float(self.curvature0[piece_table.index_at(self.arrays(), float(s))])

    def slope(self, s: float) -> float:
        """Return the slope dz/ds of the centre line at s, uphill positive."""
        i = piece_table.index_at(self.arrays(), float(s))
        rise = self.z_left1[i] + self.z_right1[i] - self.z_left0[i] - self.z_right0[i]
        return float(rise / 2.0 / self.length[i])

    def _pieces_at(self, s: FloatArray) -> tuple[NDArray[np.intp], FloatArray]:
        """Return the piece index and the distance (m) from the piece's start of each `s` (m)."""
        wrapped = np.mod(s, self.length_m)
        # np.mod of a tiny negative number may round up to the modulus itself.
        wrapped = np.where(wrapped >= self.length_m, 0.0, wrapped)
        index = np.searchsorted(self.s0, wrapped, side="right") - 1
        return index, wrapped - self.s0[index]


def wrap_angle(angle: FloatArray | np.float64) -> FloatArray:
    """Wrap angles (rad) into (-pi, pi]."""
    return np.asarray(np.pi - np.mod(np.pi - angle, 2.0 * np.pi), dtype=np.float64)
