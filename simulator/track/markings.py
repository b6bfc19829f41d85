"""Paint of a track's lane markings. Lengths in metres."""

import hashlib
from dataclasses import dataclass
from typing import Literal

LineColour = Literal["white", "yellow"]


@dataclass(frozen=True)
class MarkingStyle:
    """Paint of one track: outer lines are solid, lane dividers are dashed."""

    line_width: float = 0.12
    """Width of a line, 0.11 to 0.15 m."""
    dash_length: float = 4.0
    dash_gap: float = 8.0
    left_colour: LineColour = "white"
    """Colour of the leftmost line; all other lines are white."""
    kerbs: bool = False
    """Whether bends have red and white kerbs beside the asphalt."""
    wear: float = 0.0
    """Share of the paint that is worn away in patches: 0 is fresh paint; with 1 there is
    no paint in the patches, and two thirds of it between them."""


def imported_style(name: str, *, kerbs: bool) -> MarkingStyle:
    """Return a random style for a track file without information on paint, with kerbs if `kerbs` is
    true. The track's `name` is the seed."""
    draw = hashlib.sha256(name.encode()).digest()
    dash_length, dash_gap = ((3.0, 6.0), (4.0, 8.0), (6.0, 12.0), (3.0, 9.0))[draw[1] % 4]
    return MarkingStyle(
        line_width=0.11 + 0.01 * (draw[0] % 5),
        dash_length=dash_length,
        dash_gap=dash_gap,
        left_colour="yellow" if draw[2] % 4 == 0 else "white",
        kerbs=kerbs,
        wear=(0.0, 0.1, 0.25, 0.4)[draw[3] % 4],
    )
