"""Selects the positions of the bridges over the road, and builds each bridge there.

The frame of a bridge has its origin on the centre line of the road, x along the road, y to the
left, z up, metres. `bridges.styles` builds the triangles, `scene.shadow_mask` the shadows.
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
"""Least height (m) above the road of the parts of a bridge that reach inside the wall lines. It is
less than CLEARANCE_M, because the sides of an arch are lower than its middle."""
APART_M = 140.0
KEEP_FREE_M = 3.0
"""Least distance (m) of trees and props from a bridge's footprint."""
DEEPEST_M = 7.0
"""No bridge is built where the terrain at its ends lies deeper than this (m) below the road."""
TRIES = 12


@dataclass(frozen=True)
class Bridge:
    """One bridge over the road at `s` (m). `place` (3,), m, and `heading`, rad, are the pose of the
    bridge's frame in the world. `triangles` (n, 12) are world vertices, three a triangle: position,
    normal, colour, u, v, material number. `boxes` (m, 2, 3), m, cast the shadow; each is given by
    its least and greatest corner in the bridge's frame. The footprint is the rectangle within
    `half_along` and `half_across` (m) of the bridge's origin."""

    s: float
    place: FloatArray
    heading: float
    triangles: FloatArray
    boxes: FloatArray
    half_along: float
    half_across: float

    def inside(self, points: FloatArray) -> FloatArray:
        """Convert `points` (..., 3), m, from the world frame to the bridge's frame, in the same
        shape."""
        return self.turned(points - self.place)

    def turned(self, direction: FloatArray) -> FloatArray:
        """Rotate directions (..., 3) from the world frame into the bridge's frame, in the same
        shape."""
        return np.asarray(direction @ _turn(self.heading))

    def near(self, x: FloatArray, y: FloatArray, margin_m: float | FloatArray) -> NDArray[np.bool_]:
        """Return a mask of the world points x, y (m, arrays of one shape), in this shape. It is
        True inside the bridge's footprint, extended by `margin_m` (m) on each side."""
        own = self.inside(np.stack([x, y, np.zeros_like(x)], axis=-1))
        along, across = np.abs(own[..., 0]), np.abs(own[..., 1])
        return (along < self.half_along + margin_m) & (across < self.half_across + margin_m)


def _turn(heading: float) -> FloatArray:
    """Return the rotation matrix T (3, 3) of a bridge with the direction `heading` (rad). T @
    column converts a direction from the bridge's frame to the world, row @ T converts it back."""
    cos, sin = np.cos(heading), np.sin(heading)
    return np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])


def free_of(
    bridges: Sequence[Bridge],
    x: FloatArray,
    y: FloatArray,
    margin_m: float | FloatArray = KEEP_FREE_M,
) -> NDArray[np.bool_]:
    """Return a mask of the world points x, y (m, arrays of one shape), in this shape. It is True
    outside the footprints of all bridges, extended by `margin_m` (m) on each side."""
    free = np.ones(np.shape(x), dtype=np.bool_)
    for bridge in bridges:
        free &= ~bridge.near(x, y, margin_m)
    return free


def build(ground: Ground, theme: Theme, rng: np.random.Generator) -> tuple[Bridge, ...]:
    """Build the bridges of a scene, sorted by s: about one every `theme.bridge_every_m` (m), at
    least 140 m apart. A bridge is left out if none of 12 random positions has room for it."""
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
    """Return whether a bridge leaves room for traffic: all its parts that are less than HEADROOM_M
    above the road height `z` (m) must lie outside the wall lines of every part of the track. The
    test is needed because in a bend an embankment can reach inside the wall lines. `points` (n, 3),
    m, world, are the corners of the bridge's triangles."""
    corners = points.reshape(-1, 3, 3)
    edges = (corners + np.roll(corners, 1, axis=1)) / 2.0
    every = np.concatenate([points, edges.reshape(-1, 3)])
    low = every[every[:, 2] < z + HEADROOM_M]
    return bool(np.all(ground.line.distance(low[:, 0], low[:, 1]) > ground.road.wall_offset))


def _built(ground: Ground, s: float, style: str, rng: np.random.Generator) -> Bridge | None:
    """Build a bridge of `style` over the road at `s` (m); None if there is no room for it."""
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
