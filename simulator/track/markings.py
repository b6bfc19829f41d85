"""How a track's lane markings are painted. Lengths in metres."""

from dataclasses import dataclass
from typing import Literal

LineColour = Literal["white", "yellow"]


@dataclass(frozen=True)
class MarkingStyle:
    """Paint of one track: outer lines are solid, lane dividers dashed."""

    line_width: float = 0.12
    """Width of a line, 0.11 to 0.15 m."""
    dash_length: float = 4.0
    dash_gap: float = 8.0
    left_colour: LineColour = "white"
    """Colour of the leftmost line; all others are white."""
    kerbs: bool = False
    """Red and white kerbs beside the asphalt in bends."""
    wear: float = 0.0
    """0: fresh paint; 1: all of it worn away in patches."""
