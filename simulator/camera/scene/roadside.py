"""Applies the look of a road of `--roads varied` to its barriers, scenery theme and parked cars.
Lengths are in metres."""

from dataclasses import dataclass, replace

import numpy as np

from simulator.arrays import FloatArray
from simulator.camera.scene.themes import Colour, Theme
from simulator.track.road import Road
from simulator.varied.look import RoadLook

DRIVEN_M = 1.35
"""Largest distance (m) beyond the outermost marking of the centre of a car on datagen's
trajectories."""
PARKED_M = 2.1
"""Width (m) of the strip that a parked car needs."""
BRIDGES = ("overpass", "footbridge", "gantry", "railway")
"""Styles of bridges that are used if a scenery theme has no bridges of its own."""


@dataclass(frozen=True)
class NearRoad(Road):
    """A road for drawing, with barriers nearer to the asphalt than the walls that cars hit."""

    gap_m: float = 0.0
    """Least distance from the asphalt to the barriers."""

    @property
    def wall_offset(self) -> float:
        least = self.lanes * self.lane_width / 2 + DRIVEN_M
        near = max(self.half_asphalt + self.gap_m, least)
        return min(super().wall_offset, near)


def seen_road(road: Road, look: RoadLook | None) -> Road:
    """Return the road to draw. If `look.roadside.gap_m` is 0 or more, the drawn barriers may stand
    nearer to the asphalt than the walls that cars hit."""
    if look is None or look.roadside.gap_m < 0.0:
        return road
    return NearRoad(road.track, road.lanes, road.lane_width, road.carriageway, look.roadside.gap_m)


def seen_theme(theme: Theme, look: RoadLook | None) -> Theme:
    """Return the scenery theme to draw: `theme` with the trees, grass, lamps and bridges of `look`,
    or `theme` itself if `look` is None."""
    if look is None:
        return theme
    roadside, lit = look.roadside, look.light.night and look.light.lamp_every_m > 0.0
    theme = replace(
        theme,
        tree_density=theme.tree_density * roadside.trees,
        grass=_mixed(theme.grass, theme.dry, roadside.dry),
        lamps=theme.lamps and not lit,
    )
    if roadside.bridge_every_m > 0.0:
        styles = theme.bridges or BRIDGES
        theme = replace(theme, bridges=styles, bridge_every_m=roadside.bridge_every_m)
    return theme


def _mixed(one: Colour, other: Colour, share: float) -> Colour:
    red, green, blue = (a + share * (b - a) for a, b in zip(one, other, strict=True))
    return red, green, blue


def parked_cars(road: Road, every_m: float, rng: np.random.Generator) -> FloatArray:
    """Return poses (n, 6; m, rad, world), on the ground, of cars parked along `road`, on each side
    one every `every_m` (m) on average. They stand on the shoulder if that is at least 2.1 m wide,
    else beside the asphalt if there is room. There are none if `every_m` is 0."""
    if every_m <= 0.0:
        return np.empty((0, 6))
    poses = []
    for side, end in zip((1.0, -1.0), road.asphalt, strict=True):
        shoulder = end - road.lanes * road.lane_width / 2
        beside = road.wall_offset - end > PARKED_M
        if shoulder < PARKED_M and not beside:
            continue
        y = side * (end + (-0.5 if shoulder >= PARKED_M else 0.5) * PARKED_M)
        steps = every_m * rng.uniform(0.5, 1.5, int(road.track.length_m / every_m))
        s = np.cumsum(steps)
        s = s[s < road.track.length_m - 8.0]
        here, ahead = road.track.at(s, y), road.track.at(s + 0.5, y)
        behind = road.track.at(s - 0.5, y)
        pitch = np.arctan2(behind.z - ahead.z, np.hypot(ahead.x - behind.x, ahead.y - behind.y))
        turned = side > 0.0
        poses.append(
            np.stack(
                [
                    here.x,
                    here.y,
                    here.z,
                    np.zeros_like(s),
                    -pitch if turned else pitch,
                    here.heading + (np.pi if turned else 0.0) + rng.normal(0.0, 0.02, len(s)),
                ],
                axis=1,
            )
        )
    return np.concatenate(poses) if poses else np.empty((0, 6))
