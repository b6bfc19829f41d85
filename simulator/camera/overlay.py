"""The true markings over a picture: where the painted lines must lie. Pixels, origin top left."""

from typing import TYPE_CHECKING, Protocol

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from simulator.camera.optics import NEAR_M
from simulator.track.road import Road

if TYPE_CHECKING:
    from simulator.state import CarState

FloatArray = NDArray[np.float64]

STEP_M = 1.0
BEHIND_M = 2.0
_COLOUR = (255, 0, 200)


class Seen(Protocol):
    """What of a camera an overlay needs."""

    width: int
    height: int

    def project(
        self, points: ArrayLike, body_pose: ArrayLike, view: str = "front"
    ) -> tuple[FloatArray, FloatArray]:
        """Pixels and depth of world points."""
        ...


def marking_polylines(
    camera: Seen,
    road: Road,
    at: "CarState | tuple[float, ArrayLike]",
    ahead_m: float = 60.0,
    view: str = "front",
) -> list[FloatArray]:
    """Pixel polylines (n, 2) of the centres of the true markings, leftmost first.

    `at` is (s, body pose) of the car, or its state. Each line runs from just behind the eye to
    `ahead_m`; what lies behind the eye or far outside the picture is cut off, hills do not hide it.
    """
    s, body_pose = at if isinstance(at, tuple) else (at.s, pose_of_state(at))
    # Backward views look at the road behind the car.
    start, end = (-ahead_m, BEHIND_M) if view == "rear" else (-BEHIND_M, ahead_m)
    if view in ("top", "left", "right"):
        start = -ahead_m
    distances = s + np.arange(start, end + STEP_M / 2, STEP_M)
    lines = []
    for y in road.markings_y:
        place = road.track.at(distances, y)
        points = np.stack([place.x, place.y, place.z], axis=1)
        pixels, depth = camera.project(points, body_pose, view)
        lines += _inside(camera, pixels, depth)
    return lines


def pose_of_state(state: "CarState") -> FloatArray:
    """Body pose (6,) of a car's state."""
    return np.array([state.x, state.y, state.z, state.roll, state.pitch, state.yaw])


def draw(
    image: NDArray[np.uint8],
    polylines: list[FloatArray],
    colour: tuple[int, int, int] = _COLOUR,
) -> NDArray[np.uint8]:
    """A copy of `image` (H, W, 3) with thin antialiased lines over it."""
    drawn = image.copy()
    # cv2 counts from the centre of the first pixel and takes 1/16 pixels as integers.
    fixed = [np.rint((line - 0.5) * 16.0).astype(np.int32) for line in polylines]
    cv2.polylines(drawn, fixed, False, colour, 1, cv2.LINE_AA, shift=4)
    return drawn


def _inside(camera: Seen, pixels: FloatArray, depth: FloatArray) -> list[FloatArray]:
    """Runs of at least two points that lie before the eye and near the picture."""
    margin = 0.5 * max(camera.width, camera.height)
    u, v = pixels[:, 0], pixels[:, 1]
    near = (
        (u > -margin) & (u < camera.width + margin) & (v > -margin) & (v < camera.height + margin)
    )
    good = (depth > 2.0 * NEAR_M) & near
    breaks = np.flatnonzero(np.diff(good.astype(np.int8)) != 0) + 1
    runs = np.split(np.arange(len(good)), breaks)
    return [pixels[run] for run in runs if good[run[0]] and len(run) >= 2]
