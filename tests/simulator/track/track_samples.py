"""Small tracks with known dimensions: stadiums, and a figure of eight with a bridge."""

import math

from simulator.track.geometry import Track
from simulator.track.markings import MarkingStyle
from simulator.track.pieces import Piece, assemble


def build(pieces: list[Piece], width: float = 10.0, look: str = "circuit") -> Track:
    return Track.from_placed(
        assemble(pieces),
        name="sample",
        source="own",
        width=width,
        surface="asphalt",
        look=look,
        markings=MarkingStyle(),
    )


def stadium() -> Track:
    """Counter-clockwise from (0, 0): 100 m straights, bends of radius 50 m, banked and hilly."""
    return build(
        [
            Piece(100.0, 0.0, 0.0, 0.0, 2.0, 4.0),
            Piece(50.0 * math.pi, 1.0 / 50.0, 2.0, 4.0, 6.0, 6.0),
            Piece(100.0, 0.0, 6.0, 6.0, 3.0, 3.0),
            Piece(50.0 * math.pi, 1.0 / 50.0, 3.0, 3.0, 0.0, 0.0),
        ]
    )


def flat_stadium(straight: float, radius: float = 40.0, width: float = 12.0) -> Track:
    """Two straights and two half circles to the left."""
    bend = Piece(math.pi * radius, 1.0 / radius, 0.0, 0.0, 0.0, 0.0)
    return build([Piece(straight, 0.0, 0.0, 0.0, 0.0, 0.0), bend] * 2, width)


def figure_of_eight() -> Track:
    """Straights of 120 m that cross at right angles, one 6 m above the other.

    It starts at the crossing, on the lower road; the upper one passes there half a lap later.
    """
    loop = 1.5 * math.pi * 60.0
    return build(
        [
            Piece(60.0, 0.0, 0.0, 0.0, 0.0, 0.0),
            Piece(loop, 1.0 / 60.0, 0.0, 0.0, 6.0, 6.0),
            Piece(120.0, 0.0, 6.0, 6.0, 6.0, 6.0),
            Piece(loop, -1.0 / 60.0, 6.0, 6.0, 0.0, 0.0),
            Piece(60.0, 0.0, 0.0, 0.0, 0.0, 0.0),
        ]
    )
