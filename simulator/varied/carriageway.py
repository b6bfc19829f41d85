"""Lanes, shoulders, camera height and lines of one round. Metres; the leftmost line comes first.

Neighbouring markings are one lane width apart, equal for all lanes. The two lines of a double line
between lanes lie on both sides of the marking's nominal position. At an edge of the road, the inner
of the two lines lies at that position.
"""

import math
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

from simulator.varied.draw import draw, generator, ranges, rebuilt
from trackfeatures.camera import CameraParameters
from trackfeatures.definitions import LANE_WIDTH_LIMITS_M

APPARENT_WIDTH_M = (2.75, 4.4)
"""Least and greatest apparent width (m) of a lane in the model's pictures. A camera at another
height shows the road scaled by the ratio of the heights."""
MODEL_HEIGHT_M = CameraParameters().height_above_road_m
CAMERA_HEIGHT_M = (0.9, 2.2)
BESIDE_PAINT_M = 0.05
"""Least width (m) of the asphalt outside the paint of an edge. Paint beyond the asphalt would not
be visible, and the visible rest of a line would not be where the label says."""


@dataclass(frozen=True, slots=True)
class Line:
    """One line of paint, or a row of dots. Its middle is `offset_m` left of the nominal position of
    its marking."""

    offset_m: float
    width_m: float
    colour: str
    dash_m: float = 0.0
    """Length of a dash."""
    gap_m: float = 0.0
    """Gap between two dashes; 0: the line is solid, or consists only of dots."""
    dots_m: float = 0.0
    """Distance between Botts' dots, which lie where there is no paint; 0: no dots."""


@dataclass(frozen=True, slots=True)
class Marking:
    """One marking: no line, one line, or two lines, the left one first."""

    lines: tuple[Line, ...] = ()

    @property
    def left_m(self) -> float:
        """Offset (m, left positive) of the marking's leftmost line from the nominal position. This
        line bounds the lane to the left of the marking. 0 if there is no line."""
        return self.lines[0].offset_m if self.lines else 0.0

    @property
    def right_m(self) -> float:
        """Offset (m, left positive) of the marking's rightmost line from the nominal position. This
        line bounds the lane to the right of the marking. 0 if there is no line."""
        return self.lines[-1].offset_m if self.lines else 0.0


@dataclass(frozen=True, slots=True)
class Carriageway:
    """The random values of one round's road: lanes, shoulders, camera height and markings. The
    track is selected separately."""

    lane_width_m: float
    shoulders_m: tuple[float, float]
    """Width of the asphalt beyond the outermost markings, left and right."""
    camera_height_m: float
    """Height of the camera above the road."""
    markings: tuple[Marking, ...]
    """The markings from left to right, one more than lanes."""

    @staticmethod
    def drawn(seed: int, lanes: int, model_height_m: float = MODEL_HEIGHT_M) -> "Carriageway":
        """Return the random road with `lanes` lanes of the round with `seed`. `model_height_m` is
        the height (m) of the model's camera above the road."""
        size = draw(ranges(), "lanes", generator(seed, "lanes"))
        place = draw(ranges(), "camera", generator(seed, "camera"))["place"]
        width = round(float(size["width_m"]), 3)
        markings = _markings(draw(ranges(), "lines", generator(seed, "lines")), lanes, width)
        taken = max(right.left_m - left.right_m for left, right in pairwise(markings))
        low, high = camera_heights(width, width - taken, model_height_m)
        shoulders = [
            round(max(float(size[f"shoulder_{side}_m"]), least), 3) if least else 0.0
            for side, least in (
                ("left", _asphalt_for(markings[0], 1.0)),
                ("right", _asphalt_for(markings[-1], -1.0)),
            )
        ]
        return Carriageway(
            lane_width_m=width,
            shoulders_m=(shoulders[0], shoulders[1]),
            camera_height_m=round(low + (high - low) * float(place), 4),
            markings=markings,
        )

    @staticmethod
    def from_dict(values: dict[str, Any]) -> "Carriageway":
        """Return the carriageway whose `dataclasses.asdict` is `values`, also after a round trip
        through JSON. Raises KeyError, TypeError or ValueError if a field is unknown or a required
        field is missing."""
        found: Carriageway = rebuilt(Carriageway, values)
        return found


def _asphalt_for(edge: Marking, outwards: float) -> float:
    """Return the width (m) of the asphalt beyond the nominal position of the marking `edge` that
    its paint needs; 0 without paint. `outwards` is 1 for the left edge and -1 for the right one."""
    reach = [outwards * line.offset_m + line.width_m / 2 for line in edge.lines]
    return max(reach) + BESIDE_PAINT_M if reach else 0.0


def camera_heights(
    lane_width_m: float, narrowest_m: float = math.inf, model_height_m: float = MODEL_HEIGHT_M
) -> tuple[float, float]:
    """Return the least and greatest height (m) of a camera in whose pictures a model sees lanes of
    `lane_width_m` (m) as 2.75 to 4.4 m wide. The heights are within 0.9 to 2.2 m if possible.
    `model_height_m` (m) is the height of the model's training camera.

    `narrowest_m` (m) is the width of the narrowest lane, since a double line occupies some of the
    width.
    """
    apparent_low, apparent_high = APPARENT_WIDTH_M
    low, high = CAMERA_HEIGHT_M
    narrow = min(lane_width_m, narrowest_m)
    low = max(low, model_height_m * lane_width_m / apparent_high)
    return low, max(low, min(high, model_height_m * narrow / apparent_low))


def _markings(drawn: dict[str, Any], lanes: int, lane_width_m: float) -> tuple[Marking, ...]:
    """Return the markings of a road with `lanes` lanes of `lane_width_m` (m). `drawn` contains the
    random values of the section [lines] of ranges.toml."""
    # A lane beside a double line must not be narrower than the definitions allow.
    room = lane_width_m - LANE_WIDTH_LIMITS_M[0]
    left = _marking(drawn, "left", drawn["edge_width_m"], drawn["edge_dash_m"], 0.5)
    right = _marking(drawn, "right", drawn["edge_width_m"], drawn["edge_dash_m"], -0.5)
    between = _marking(drawn, "divider", drawn["divider_width_m"], drawn["dash_m"], 0.0, room)
    return (left, *[between] * (lanes - 1), right)


def _marking(
    drawn: dict[str, Any],
    name: str,
    width_m: float,
    dash: list[float],
    inner: float,
    room_m: float = math.inf,
) -> Marking:
    """Return the marking `name` ("left", "right" or "divider"), of one of the kinds in ranges.toml.
    `drawn` contains the random values of the section [lines], `width_m` is the width of a line, and
    `dash` contains the lengths (m) of a dash and of a gap.

    `inner` shifts a double line to the left by this share of the distance between its lines. If the
    lines are more than `room_m` (m) apart, only the first line is used.
    """
    kind, colour = str(drawn[name]), str(drawn[f"{name}_colour"])
    apart = width_m + float(drawn["apart_m"])
    solid, dashed = (0.0, 0.0), (dash[0], dash[1])

    def line(pattern: str, place: float = 0.0) -> Line:
        length, gap = dashed if "dashed" in pattern else solid
        dots = float(drawn["dots_m"]) if "dots" in pattern else 0.0
        return Line(round(place * apart, 4), round(width_m, 4), colour, length, gap, dots)

    if kind == "none":
        return Marking()
    if kind in ("solid", "dashed", "dots", "dots-dashed"):
        return Marking((line(kind),))
    first, second = kind.split("-") if "-" in kind else ("solid", "solid")
    if apart > room_m:
        return Marking((line(first),))
    return Marking((line(first, inner + 0.5), line(second, inner - 0.5)))
