"""The shadows that bridges throw on the road, traced from the road towards the sun."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from simulator.camera.bridges.bridges import Bridge
from simulator.camera.scene.light import Light
from simulator.track.road import Road

FloatArray = NDArray[np.float64]
Strip = NDArray[np.uint8]

FINE = 2
"""Rays a texel in each direction; their mean softens the edge by a texel."""
ROAD_Z_M = 2.5
"""The road near a bridge lies within so much of its height below the bridge."""
FARTHEST_M = 70.0


def cast_bridges(
    strip: Strip,
    road: Road,
    along_m: float,
    texel_m: float,
    bridges: Sequence[Bridge],
    light: Light,
) -> None:
    """Darken the texels of `strip` (rows, columns) from which a bridge hides the sun."""
    for bridge in bridges:
        sun = bridge.turned(np.array(light.sun_direction))
        low, high = _reach(bridge.boxes, sun)
        # On the inside of a bend a metre of s is shorter, so that more of it is needed.
        bend = 1.0 / max(0.5, 1.0 - abs(road.track.curvature(bridge.s)) * road.wall_offset)
        first = int((bridge.s + max(low * bend, -FARTHEST_M)) / along_m) - 8
        last = int((bridge.s + min(high * bend, FARTHEST_M)) / along_m) + 9
        dark = _darkened(bridge, road, along_m, texel_m, (first, last), strip.shape[0], sun)
        columns = np.arange(first, last) % strip.shape[1]
        strip[:, columns] = np.maximum(strip[:, columns], dark)


def _reach(boxes: FloatArray, sun: FloatArray) -> tuple[float, float]:
    """How far along the road the shadows of the boxes begin and end."""
    drop = boxes[:, 1, 2] + ROAD_Z_M
    shift = -sun[0] / max(sun[2], 1e-3) * drop
    low = np.minimum(boxes[:, 0, 0], boxes[:, 0, 0] + shift)
    high = np.maximum(boxes[:, 1, 0], boxes[:, 1, 0] + shift)
    return float(low.min()), float(high.max())


def _darkened(
    bridge: Bridge,
    road: Road,
    along_m: float,
    texel_m: float,
    columns: tuple[int, int],
    rows: int,
    sun: FloatArray,
) -> Strip:
    """The shadow on texels (rows, columns) of the unfolded mask; columns may pass its ends."""
    first, last = columns
    s = (first + (np.arange((last - first) * FINE) + 0.5) / FINE) * along_m
    y = ((np.arange(rows * FINE) + 0.5) / FINE - rows / 2) * texel_m
    pose = road.track.at(s[None, :] % road.track.length_m, y[:, None])
    own = bridge.inside(np.stack(np.broadcast_arrays(pose.x, pose.y, pose.z), axis=-1))
    slope = np.where(np.abs(sun) > 1e-6, sun, 1e-6)
    reached = [np.ascontiguousarray(own[..., k] / slope[k], dtype=np.float32) for k in range(3)]
    hidden = np.zeros(own.shape[:2], dtype=np.bool_)
    for box in bridge.boxes:
        hidden |= _hit(reached, box / slope)
    shares = hidden.reshape(rows, FINE, last - first, FINE).mean(axis=(1, 3))
    return np.asarray(np.rint(255.0 * shares), dtype=np.uint8)


def _hit(reached: list[NDArray[np.float32]], box: FloatArray) -> NDArray[np.bool_]:
    """From which points a ray towards the sun meets a box (slab method).

    All is measured along the ray: each coordinate of points and box (2, 3) comes divided by the
    ray's slope in it.
    """
    enter = np.zeros_like(reached[0])
    leave = np.full_like(reached[0], np.inf)
    for axis, place in enumerate(reached):
        np.maximum(enter, np.float32(box[:, axis].min()) - place, out=enter)
        np.minimum(leave, np.float32(box[:, axis].max()) - place, out=leave)
    return np.asarray(enter < leave)
