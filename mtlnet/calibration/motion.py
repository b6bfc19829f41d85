"""Estimates a camera's rotation and direction of travel between two pictures from followed points.

Camera frame: x right, y down, z ahead. For a small rotation `w` and travel along T, the ray p = (x,
y, 1) of a point at rest moves by v with (T x p) . (v + w x p) = 0, whatever its distance
(Longuet-Higgins and Prazdny 1980).
"""

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

POINTS = 250
MIN_POINTS = 40
MIN_SPREAD_PX = 8
WINDOW = (21, 21)
LEVELS = 4
MAX_RETURN_PX = 0.5
"""Maximum distance (px) of a point from its position after it was followed forward and back."""
BONNET = 0.12
"""Share of the picture's rows, at its bottom, that are ignored: they can show the car's bonnet."""
ROUNDS = 8
MIN_MOTION_PX = 0.5
MAX_CONDITION = 1e12


@dataclass(frozen=True)
class Motion:
    """Motion of a camera between two pictures: its `rotation` (3,) rad, and the point `towards`
    (2,) which it travels, x and y in normalised coordinates. `towards_std` is the standard
    deviation of this point."""

    rotation: FloatArray
    towards: FloatArray
    towards_std: float


def follow(before: NDArray[np.uint8], after: NDArray[np.uint8]) -> FloatArray | None:
    """Follow points between two grayscale images (H, W); returns (N, 4): u and v in px in `before`,
    then in `after`. None if fewer than 40 points can be followed, or if fewer than a quarter of
    them move by at least 0.5 px."""
    seen = np.full(before.shape, 255, np.uint8)
    seen[round((1 - BONNET) * len(seen)) :] = 0
    found = cv2.goodFeaturesToTrack(before, POINTS, 0.005, MIN_SPREAD_PX, mask=seen)
    if found is None or len(found) < MIN_POINTS:
        return None
    there, good = _flow(before, after, found)
    back, good_back = _flow(after, before, there)
    steady = np.abs(back - found).max(axis=(1, 2)) < MAX_RETURN_PX
    chosen = (good.ravel() == 1) & (good_back.ravel() == 1) & steady
    tracks = np.concatenate([found[chosen, 0], there[chosen, 0]], axis=1).astype(np.float64)
    moved = np.hypot(*(tracks[:, 2:] - tracks[:, :2]).T)
    if len(tracks) < MIN_POINTS or np.percentile(moved, 75) < MIN_MOTION_PX:
        return None
    return tracks


def _flow(before: NDArray[np.uint8], after: NDArray[np.uint8], points: Any) -> tuple[Any, Any]:
    """Follow points (N, 1, 2) by the method of Lucas and Kanade; returns their positions in `after`
    and a flag (N, 1), 1 for the points that were found."""
    there, found, _ = cv2.calcOpticalFlowPyrLK(
        before, after, points, np.empty_like(points), winSize=WINDOW, maxLevel=LEVELS
    )
    return there, found


def find_motion(tracks: FloatArray, towards: FloatArray, noise: float) -> Motion | None:
    """Estimate the camera's motion from `tracks` (N, 4), the normalised x, y of N points in the
    first picture, then in the second. None if the tracks do not determine the motion.

    `towards` (2,): a first guess of the point towards which the camera travels. `noise`: standard
    deviation of a track, in normalised coordinates.
    """
    n = len(tracks)
    p = np.column_stack([0.5 * (tracks[:, :2] + tracks[:, 2:]), np.ones(n)])
    v = np.column_stack([tracks[:, 2:] - tracks[:, :2], np.zeros(n)])
    rotation, heading = np.zeros(3), np.array([*towards, 1.0])
    across = np.eye(3)[:2]
    scale = 20 * noise
    for step in range(ROUNDS):
        normal = np.cross(heading, p)
        length = np.maximum(np.hypot(normal[:, 0], normal[:, 1]), 0.02)
        left = v + np.cross(rotation, p)
        error = np.einsum("ni,ni->n", normal, left) / length
        by_rotation = heading * np.sum(p * p, axis=1)[:, None] - p * (p @ heading)[:, None]
        by_heading = np.cross(p, left) @ across.T  # (dT x p) . left = dT . (p x left)
        design = np.concatenate([by_rotation, by_heading], axis=1) / length[:, None]
        scale = max(1.4826 * float(np.median(np.abs(error))), noise) if step else scale
        weight = 1.0 / (1.0 + (error / (2.0 * scale)) ** 2) ** 2
        held = np.diag(
            [0.0, 0.0, 0.0, *(2 * [(scale / 0.05) ** 2])]
        )  # the guess has a standard deviation of 3 degrees
        system = design.T @ (weight[:, None] * design) + held
        pull = held[3:, 3:] @ (heading[:2] - towards)
        right = -design.T @ (weight * error) - np.concatenate([np.zeros(3), pull])
        if not np.linalg.cond(system) < MAX_CONDITION:  # e.g. all points close together
            return None
        change = np.linalg.solve(system, right)
        rotation += change[:3]
        heading[:2] += change[3:]
    covariance = scale**2 * np.linalg.inv(system)
    std = float(np.sqrt(max(covariance[3, 3], covariance[4, 4])))
    return Motion(rotation, heading[:2].copy(), std) if np.isfinite(std) else None
