"""Bridges over the road: where they stand, and the frame in which each is built.

A bridge's own frame has its origin on the centre line, x along the road, y to the left, z up,
metres. The styles are in `bridges.styles`, the shadows in `scene.shadow_mask`.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from simulator.arrays import FloatArray
from simulator.camera.bridges import styles as bridge_styles
from simulator.camera.bridges.styles import BridgeBuilder
from simulator.camera.scene.road_mesh import Ground
from simulator.camera.scene.themes import Theme

CLEARANCE_M = 5.4
HEADROOM_M = 2.5
"""Least clearance beside the asphalt, where an arch starts."""
APART_M = 140.0
KEEP_FREE_M = 3.0
"""Least distance of trees and props from a bridge."""
DEEPEST_M = 7.0
"""Largest depth of the terrain below the road at the ends of a bridge."""
TRIES = 12


@dataclass(frozen=True)
class Bridge:
    """One bridge: its place, the heading of the road below, its triangles (n, 12) in the world, and
    the boxes that cast its shadow (m, 2, 3): least and greatest corner of each in the bridge's
    frame."""

    s: float
    place: FloatArray
    heading: float
    triangles: FloatArray
    boxes: FloatArray
    half_along: float
    half_across: float

    def inside(self, points: FloatArray) -> FloatArray:
        """World points (..., 3) converted to the bridge's own frame."""
        return self.turned(points - self.place)

    def turned(self, direction: FloatArray) -> FloatArray:
        """World directions (..., 3) converted to the bridge's own frame."""
        return np.asarray(direction @ _turn(self.heading))

    def near(self, x: FloatArray, y: FloatArray, margin_m: float | FloatArray) -> NDArray[np.bool_]:
        """Mask of the points x, y (m, world) that lie within `margin_m` of the bridge's
        footprint."""
        own = self.inside(np.stack([x, y, np.zeros_like(x)], axis=-1))
        along, across = np.abs(own[..., 0]), np.abs(own[..., 1])
        return (along < self.half_along + margin_m) & (across < self.half_across + margin_m)


def _turn(heading: float) -> FloatArray:
    """Rotation (3, 3): turn @ column maps a bridge's frame to the world, row @ turn the reverse."""
    cos, sin = np.cos(heading), np.sin(heading)
    return np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])


def free_of(
    bridges: Sequence[Bridge],
    x: FloatArray,
    y: FloatArray,
    margin_m: float | FloatArray = KEEP_FREE_M,
) -> NDArray[np.bool_]:
    """Mask of the points x, y (m, world) that are farther than `margin_m` from every bridge."""
    free = np.ones(np.shape(x), dtype=np.bool_)
    for bridge in bridges:
        free &= ~bridge.near(x, y, margin_m)
    return free


def build(ground: Ground, theme: Theme, rng: np.random.Generator) -> tuple[Bridge, ...]:
    """The bridges of a scene, about one every `theme.bridge_every_m`. No bridge stands on another
    part of the track."""
    if not theme.bridges:
        return ()
    length = ground.road.track.length_m
    bridges: list[Bridge] = []
    wanted = max(1, round(length / theme.bridge_every_m * rng.uniform(0.7, 1.3)))
    first = rng.uniform(0.0, length)
    for k in range(wanted):
        style = theme.bridges[int(rng.integers(len(theme.bridges)))]
        for _ in range(TRIES):
            s = float((first + (k + rng.uniform(0.0, 0.8)) * length / wanted) % length)
            apart = [abs((s - other.s + length / 2) % length - length / 2) for other in bridges]
            if min(apart, default=APART_M) < APART_M:
                continue
            bridge = _built(ground, s, style, rng)
            if bridge is not None:
                bridges.append(bridge)
                break
    return tuple(sorted(bridges, key=lambda bridge: bridge.s))


def _clear_of_the_road(ground: Ground, points: FloatArray, z: float) -> bool:
    """Whether all bridge parts lower than HEADROOM_M lie outside the wall lines of every part of
    the track. In a bend, an embankment can reach inside them."""
    corners = points.reshape(-1, 3, 3)
    edges = (corners + np.roll(corners, 1, axis=1)) / 2.0
    every = np.concatenate([points, edges.reshape(-1, 3)])
    low = every[every[:, 2] < z + HEADROOM_M]
    return bool(np.all(ground.line.distance(low[:, 0], low[:, 1]) > ground.road.wall_offset))


def _built(ground: Ground, s: float, style: str, rng: np.random.Generator) -> Bridge | None:
    """A bridge of `style` over the road at `s` (m), or None where there is no room for it."""
    road = ground.road
    reach = bridge_styles.half_span(style, road.wall_offset)
    across = np.linspace(road.wall_offset + 1.0, reach + 4.0, 8)
    across = np.concatenate([across, -across])
    at = np.full(len(across), s)
    free, x, y = ground.place_beside(at, across, 0.5)
    if not free.all() or abs(road.track.curvature(s)) * reach > 0.5:
        return None
    pose = road.track.at(s)
    place = np.array([pose.x, pose.y, pose.z], dtype=np.float64)
    lowest = float((ground.height(at, across, x, y) - place[2]).min())
    if lowest < -DEEPEST_M:
        return None
    along = s + np.linspace(-6.0, 6.0, 7)[:, None]
    top = float(road.track.at(along, np.linspace(-reach, reach, 9) * 0.5).z.max() - place[2])
    builder = BridgeBuilder(road.wall_offset, max(top, 0.0) + CLEARANCE_M, lowest)
    bridge_styles.STYLES[style](builder, rng)
    heading = float(pose.heading)
    triangles, boxes = builder.triangles(), builder.boxes()
    low, high = triangles[:, :3].min(axis=0), triangles[:, :3].max(axis=0)
    half_along, half_across = np.maximum(np.abs(low), np.abs(high))[:2]
    turn = _turn(heading)
    triangles[:, :3] = triangles[:, :3] @ turn.T + place
    triangles[:, 3:6] = triangles[:, 3:6] @ turn.T
    if not _clear_of_the_road(ground, triangles[:, :3], place[2]):
        return None
    return Bridge(s, place, heading, triangles, boxes, float(half_along), float(half_across))
