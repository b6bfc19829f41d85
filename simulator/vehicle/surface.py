"""Friction and rolling resistance of the road surface and of the verge beside it."""

from dataclasses import dataclass

from runtime.jit import inlined
from simulator.track.road import Road


@dataclass(frozen=True)
class SurfaceFriction:
    """The effect of a surface on the tyre forces."""

    grip: float
    """Factor on the tyre's friction coefficient."""
    rolling: float
    """Factor on the rolling resistance; 1 on asphalt."""


# From TORCS's surfaces.xml (friction, rolling resistance relative to the 0.001 of asphalt): entries
# asphalt, concrete4, dirt; the verge is b-asphalt-grass, the strip between road and grass.
SURFACES = {
    "asphalt": SurfaceFriction(1.2, 1.0),
    "concrete": SurfaceFriction(1.1, 1.5),
    "gravel": SurfaceFriction(0.9, 6.0),
}
VERGE = SurfaceFriction(0.8, 5.0)

Ground = tuple[float, float, float, float, float]
"""Grip and rolling factor of the road, grip and rolling factor of the verge, and the distance (m)
from the centre at which the verge begins."""


def ground(road: Road) -> Ground:
    """Return (grip, rolling factor) of the road, then of the verge, and the distance (m) from the
    centre at which the verge begins, as a tuple for compiled code."""
    surface = SURFACES[road.track.surface]
    return (surface.grip, surface.rolling, VERGE.grip, VERGE.rolling, road.half_asphalt)


@inlined
def surface_under_wheel(ground: Ground, to_middle: float) -> tuple[float, float]:
    """Return the grip and the rolling factor (see `SurfaceFriction`) at a lateral offset (m) from
    the track's centre."""
    if abs(to_middle) > ground[4]:
        return ground[2], ground[3]
    return ground[0], ground[1]
