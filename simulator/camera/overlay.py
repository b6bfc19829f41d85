"""Projects the true lane markings into an image and draws them. Coordinates are in pixels."""

from typing import TYPE_CHECKING, Protocol

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from simulator.arrays import FloatArray
from simulator.camera.core.optics import NEAR_M
from simulator.track.piece_table import road_points
from simulator.track.road import Road

if TYPE_CHECKING:
    from simulator.vehicle.state import CarState


STEP_M = 1.0
BEHIND_M = 2.0
_COLOUR = (255, 0, 200)


class Projector(Protocol):
    """The part of `Camera` that the overlay uses."""

    width: int
    height: int

    def project(
        self, points: ArrayLike, body_pose: ArrayLike, view: str = "front"
    ) -> tuple[FloatArray, FloatArray]:
        """Return pixels (N, 2) and depth (N,) m of world points (N, 3) m."""


def marking_polylines(
    camera: Projector,
    road: Road,
    at: "CarState | tuple[float, ArrayLike]",
    ahead_m: float = 60.0,
    view: str = "front",
) -> list[FloatArray]:
    """Return pixel polylines (n, 2) along the centres of the true markings, leftmost first. Of a
    double line, the polyline follows the line nearer to the car's lane.

    `at` is (s, body pose) of the car, or its state. The polylines reach from 2 m behind the car to
    `ahead_m` ahead of it. In the views top, left and right they begin `ahead_m` behind the car; in
    the rear view they reach from `ahead_m` behind the car to 2 m ahead. Points behind the camera or
    far outside the image are removed. Occlusion by hills is ignored.
    """
    s, body_pose = at if isinstance(at, tuple) else (at.s, pose_of_state(at))
    # The rear view shows the road behind the car.
    start, end = (-ahead_m, BEHIND_M) if view == "rear" else (-BEHIND_M, ahead_m)
    if view in ("top", "left", "right"):
        start = -ahead_m
    distances = s + np.arange(start, end + STEP_M / 2, STEP_M)
    lines = road.markings_y
    if road.line_offsets:
        pose = np.asarray(body_pose, dtype=np.float64)
        lines = road.lines_y(road.track.project(float(pose[0]), float(pose[1]), s)[1])
    points = road_points(road.track.arrays(), distances, lines)
    pixels, depth = camera.project(points.reshape(-1, 3), body_pose, view)
    good = _near_picture(camera, pixels, depth).reshape(points.shape[:2])
    return _runs(pixels.reshape(*points.shape[:2], 2), good)


def pose_of_state(state: "CarState") -> FloatArray:
    """Return the body pose (6,) of a car's state: x, y, z (m), roll, pitch, yaw (rad)."""
    return np.array([state.x, state.y, state.z, state.roll, state.pitch, state.yaw])


def draw(
    image: NDArray[np.uint8],
    polylines: list[FloatArray],
    colour: tuple[int, int, int] = _COLOUR,
) -> NDArray[np.uint8]:
    """Return a copy of `image` (H, W, 3) with the polylines, (n, 2) px each, drawn thin and
    antialiased. `colour` is in the image's order of channels."""
    drawn = image.copy()
    # cv2 takes integer coordinates in 1/16 pixel.
    fixed = [np.rint(line * 16.0).astype(np.int32) for line in polylines]
    cv2.polylines(drawn, fixed, False, colour, 1, cv2.LINE_AA, shift=4)
    return drawn


def _near_picture(camera: Projector, pixels: FloatArray, depth: FloatArray) -> NDArray[np.bool_]:
    """Return a mask (N,) of the points in front of the camera and not far outside the image.
    `pixels` (N, 2) and `depth` (N,), m, are the results of `Projector.project`."""
    margin = 0.5 * max(camera.width, camera.height)
    u, v = pixels[:, 0], pixels[:, 1]
    return np.asarray(
        (depth > 2.0 * NEAR_M)
        & (np.abs(u - 0.5 * (camera.width - 1)) < 0.5 * camera.width + margin)
        & (np.abs(v - 0.5 * (camera.height - 1)) < 0.5 * camera.height + margin)
    )


def _runs(lines: FloatArray, good: NDArray[np.bool_]) -> list[FloatArray]:
    """Split `lines` (L, N, 2) into runs (n, 2) of at least two consecutive `good` (L, N) points."""
    # Columns of False on both sides separate the lines and give each run a start and an end.
    padded = np.zeros((good.shape[0], good.shape[1] + 2), dtype=np.bool_)
    padded[:, 1:-1] = good
    flat = padded.ravel()
    edges = np.flatnonzero(flat[1:] != flat[:-1]).tolist()
    runs = []
    for start, end in zip(edges[::2], edges[1::2], strict=True):
        line, first = divmod(start, padded.shape[1])
        if end - start >= 2:
            runs.append(lines[line, first : first + end - start])
    return runs
