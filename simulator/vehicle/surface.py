"""What the wheels run on: asphalt or another surface, and the softer verge beside it."""

from dataclasses import dataclass

from runtime.jit import compiled
from simulator.track.road import Road


@dataclass(frozen=True)
class Surface:
    """How a surface changes the tyre."""

    grip: float
    """The tyre's friction is multiplied by it."""
    rolling: float
    """And its rolling resistance by this; asphalt has 1."""


# TORCS's surfaces.xml: friction, and rolling resistance over that of asphalt (0.001), of asphalt,
# concrete4 and dirt, and for the verge of the worn strips between road and grass (b-asphalt-grass).
SURFACES = {
    "asphalt": Surface(1.2, 1.0),
    "concrete": Surface(1.1, 1.5),
    "gravel": Surface(0.9, 6.0),
}
VERGE = Surface(0.8, 5.0)

Ground = tuple[float, float, float, float, float]
"""Grip and rolling of the road, of the verge, and how far from the centre the verge begins (m)."""


def ground(road: Road) -> Ground:
    """The ground of `road` as compiled code takes it."""
    surface = SURFACES[road.track.surface]
    return (surface.grip, surface.rolling, VERGE.grip, VERGE.rolling, road.half_asphalt)


@compiled
def under_wheel(ground: Ground, to_middle: float) -> tuple[float, float]:
    """(grip, rolling) at this distance (m) from the track's centre."""
    if abs(to_middle) > ground[4]:
        return ground[2], ground[3]
    return ground[0], ground[1]
