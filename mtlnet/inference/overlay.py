"""Draws predicted and true markings over a frame, and a view of the car from above beside it.

The road is assumed to be flat. In the car frame x points ahead and y to the left, m.
"""

import math
from collections.abc import Mapping

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from mtlnet.inference.prediction import Prediction
from trackfeatures.camera import CameraParameters

Image = NDArray[np.uint8]
Distances = Mapping[str, float | None]

TRUTH_COLOUR = (60, 220, 90)
PREDICTION_COLOUR = (255, 140, 30)
NEAR_M, FAR_M = 3.0, 14.0
SCALE = 2
"""Factor by which frames are enlarged, so that lines look thin."""
LINE_SHARE = 200
"""Number of image rows per pixel of line width."""
MAX_PX = 1e4
"""Limit of the coordinates of projected points, px; points beyond it are left out, because OpenCV
would overflow."""
TOP_VIEW_WIDTH, TOP_VIEW_METRES = 160, 16.0


def marking_line(
    distance: float, angle: float, curvature: float, at: ArrayLike | None = None
) -> NDArray[np.float64]:
    """Return points (N, 2), m in the car frame, of a marking `distance` m to the right of the car
    (negative: to the left).

    `angle`: angle of the car to the track, rad; `curvature` of the track: 1/m, positive to the
    left; `at` (N,): positions along the track, m ahead of the car; None: 24 points 3 to 14 m ahead.
    """
    along = np.linspace(NEAR_M, FAR_M, 24) if at is None else np.asarray(at, np.float64)
    left = curvature * along**2 / 2 - distance
    cos, sin = math.cos(angle), math.sin(angle)
    return np.column_stack([along * cos - left * sin, along * sin + left * cos])


def to_pixels(points: NDArray[np.float64], camera: CameraParameters) -> NDArray[np.int32]:
    """Return the pixels (M, 2), in an image of twice the size of the camera's images, of the M
    points in `points` (N, 2) that the camera sees. `points` lie on the road, m in the car frame."""
    road = np.column_stack([points, np.full(len(points), -camera.cg_height_m)])
    pixels = camera.project(road)
    pixels = pixels[np.isfinite(pixels).all(axis=1)]
    enlarged = (pixels + 0.5) * SCALE - 0.5  # about the corner of the picture, like cv2.resize
    return np.round(enlarged).astype(np.int32)


def draw_overlay(
    frame: Image,
    camera: CameraParameters,
    curvature: float,
    truth: tuple[Distances, float],
    prediction: tuple[Distances, float],
) -> Image:
    """Draw markings on a frame (H, W, 3) RGB, enlarged to twice its size, and on a view from above
    to its right; returns the picture (2 H, 2 W + 160, 3). True markings are green, predicted
    markings orange.

    `truth` and `prediction`: distances (m) by marking, and angle (rad). Both are drawn with the
    road's true `curvature` (1/m, positive to the left), which is not predicted.
    """
    size = (frame.shape[1] * SCALE, frame.shape[0] * SCALE)
    canvas = cv2.resize(frame, size, interpolation=cv2.INTER_CUBIC)
    top_view = np.full((canvas.shape[0], TOP_VIEW_WIDTH, 3), 48, np.uint8)
    styles = ((truth, TRUTH_COLOUR, 3), (prediction, PREDICTION_COLOUR, 1))
    for (distances, angle), colour, thickness in styles:
        for distance in distances.values():
            if distance is None:
                continue
            line = marking_line(distance, angle, curvature)
            pixels = to_pixels(line, camera)
            from_above = _top_view_pixels(line, top_view)
            cv2.polylines(canvas, [pixels], False, colour, thickness, cv2.LINE_AA)
            cv2.polylines(top_view, [from_above], False, colour, thickness, cv2.LINE_AA)
    _draw_car(top_view)
    return np.hstack([canvas, top_view])


def draw_markings(image: Image, camera: CameraParameters, prediction: Prediction) -> Image:
    """Return a copy of an image (H, W, 3) RGB, taken by `camera`, with the predicted markings
    drawn.

    The markings are drawn straight, because the curvature is not predicted.
    """
    canvas = image.copy()
    width = max(round(image.shape[0] / LINE_SHARE), 1)
    for distance in prediction.distances_m.values():
        if distance is not None:
            line = marking_line(distance, prediction.angle_rad, 0.0)
            draw_road_line(canvas, camera, line, PREDICTION_COLOUR, width)
    return canvas


def draw_road_line(
    canvas: Image,
    camera: CameraParameters,
    points: NDArray[np.float64],
    colour: tuple[int, int, int],
    thickness: int,
) -> None:
    """Draw a line through `points` (N, 2) on the road, m in the car frame, on the image `canvas` in
    place. Points that the camera does not see are left out. `colour`: RGB; `thickness` in px."""
    road = np.column_stack([points, np.full(len(points), -camera.cg_height_m)])
    pixels = camera.project(road)
    pixels = pixels[np.isfinite(pixels).all(1) & (np.abs(pixels) < MAX_PX).all(1)]
    line = np.round(pixels).astype(np.int32)
    cv2.polylines(canvas, [line], False, colour, thickness, cv2.LINE_AA)


def _top_view_pixels(points: NDArray[np.float64], top_view: Image) -> NDArray[np.int32]:
    scale = TOP_VIEW_WIDTH / TOP_VIEW_METRES
    u = TOP_VIEW_WIDTH / 2 - points[:, 1] * scale
    v = top_view.shape[0] * 0.8 - points[:, 0] * scale
    return np.round(np.column_stack([u, v])).astype(np.int32)


def _draw_car(top_view: Image) -> None:
    corners = np.array([[2.26, 0.97], [2.26, -0.97], [-2.26, -0.97], [-2.26, 0.97]])
    cv2.fillPoly(top_view, [_top_view_pixels(corners, top_view)], (200, 200, 210), cv2.LINE_AA)
