"""Pictures of one answer: the markings it tells drawn over the frame, and the car in its lane
from above. Flat road, car frame: x ahead, y left (m); pixels from the top left corner.
"""

import math
from collections.abc import Mapping

import cv2
import numpy as np
from numpy.typing import NDArray

from trackfeatures.camera import CameraParameters

Image = NDArray[np.uint8]
Distances = Mapping[str, float | None]

TRUTH_COLOUR = (60, 220, 90)
ANSWER_COLOUR = (255, 140, 30)
NEAR_M, FAR_M = 3.0, 14.0
SCALE = 2
"""Frames are shown this much larger, so that thin lines stay thin."""
PLAN_WIDTH, PLAN_METRES = 160, 16.0


def marking_line(distance: float, angle: float, curvature: float) -> NDArray[np.float64]:
    """Points (N, 2) of a marking `distance` m to the right, on a track at `angle` (rad) that bends
    by `curvature` (1/m, left positive)."""
    along = np.linspace(NEAR_M, FAR_M, 24)
    left = curvature * along**2 / 2 - distance
    cos, sin = math.cos(angle), math.sin(angle)
    return np.column_stack([along * cos - left * sin, along * sin + left * cos])


def to_pixels(
    points: NDArray[np.float64], camera: CameraParameters, height_m: float
) -> NDArray[np.int32]:
    """Where the camera, `height_m` over the road, sees road points (N, 2) of the car frame."""
    focal = camera.focal_px
    ahead, left = points[:, 0] - camera.x, points[:, 1] - camera.y
    pitch = math.radians(camera.pitch_deg)  # positive looks down
    depth = ahead * math.cos(pitch) + height_m * math.sin(pitch)
    down = height_m * math.cos(pitch) - ahead * math.sin(pitch)
    u = camera.width / 2 - focal * left / depth
    v = camera.height / 2 + focal * down / depth
    return np.round(np.column_stack([u, v]) * SCALE).astype(np.int32)


def draw_answer(
    frame: Image,
    camera: CameraParameters,
    height_m: float,
    curvature: float,
    truth: tuple[Distances, float],
    answer: tuple[Distances, float],
) -> Image:
    """The frame (H, W, 3) RGB, doubled, with a plan view beside it: truth green, answer orange.

    Both are drawn along the road's true bend, which no answer tells.
    """
    size = (frame.shape[1] * SCALE, frame.shape[0] * SCALE)
    canvas = cv2.resize(frame, size, interpolation=cv2.INTER_CUBIC)
    plan = np.full((canvas.shape[0], PLAN_WIDTH, 3), 48, np.uint8)
    styles = ((truth, TRUTH_COLOUR, 3), (answer, ANSWER_COLOUR, 1))
    for (distances, angle), colour, thickness in styles:
        for distance in distances.values():
            if distance is None:
                continue
            line = marking_line(distance, angle, curvature)
            pixels = to_pixels(line, camera, height_m)
            cv2.polylines(canvas, [pixels], False, colour, thickness, cv2.LINE_AA)
            cv2.polylines(plan, [_on_plan(line, plan)], False, colour, thickness, cv2.LINE_AA)
    _draw_car(plan)
    return np.hstack([canvas, plan])


def _on_plan(points: NDArray[np.float64], plan: Image) -> NDArray[np.int32]:
    scale = PLAN_WIDTH / PLAN_METRES
    u = PLAN_WIDTH / 2 - points[:, 1] * scale
    v = plan.shape[0] * 0.8 - points[:, 0] * scale
    return np.round(np.column_stack([u, v])).astype(np.int32)


def _draw_car(plan: Image) -> None:
    corners = np.array([[2.26, 0.97], [2.26, -0.97], [-2.26, -0.97], [-2.26, 0.97]])
    cv2.fillPoly(plan, [_on_plan(corners, plan)], (200, 200, 210), cv2.LINE_AA)
