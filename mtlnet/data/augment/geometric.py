"""Frames of a car some way aside: the road is shifted under the camera, the labels follow.

A camera that moves left by s sees a point at depth Z f s / Z pixels further right: on a plane, that
is s / h pixels for each row below the horizon, h the camera's height. What stands on the road is
sheared with it, and what lies above the horizon stays: right for the markings near the car.
"""

import cv2
import numpy as np
from numpy.typing import NDArray

import trackfeatures as tf
from trackfeatures.camera import CameraParameters

FURTHEST_M = 0.6


def shift_lateral(image: NDArray[np.uint8], camera: CameraParameters, metres: float) -> None:
    """Move the camera of an image (H, W, 3) to the left by `metres`, in place."""
    tilt = np.radians(camera.pitch_deg)
    focal = camera.focal_px
    horizon = (camera.height - 1) / 2 - focal * np.tan(tilt)
    first = max(int(np.ceil(horizon)), 0)
    road = image[first:]
    shear = metres * np.cos(tilt) / camera.height_above_road_m
    matrix = np.array([[1.0, shear, shear * (first - horizon)], [0.0, 1.0, 0.0]])
    # What comes into view is bare road: mirrored, a marking would turn round at the border.
    bare = image[-1].mean(0).tolist()
    size = (camera.width, len(road))
    cv2.warpAffine(road.copy(), matrix, size, dst=road, flags=cv2.INTER_LINEAR, borderValue=bare)


def room(distances: NDArray[np.float32]) -> NDArray[np.float64]:
    """How far (N, 2) a car may move right (negative) and left, m, for the same markings to count.

    `distances` (N, 5) in m, NaN where absent. Further on another marking would have to be told of,
    whose distance, or whether it is there at all, is not known.
    """
    ml, mr, l, m, r = distances.astype(np.float64).T
    margin, reach = tf.IN_LANE_MARGIN_M, tf.ON_MARKING_REACH_M
    in_lane, on_marking = ~np.isnan(ml), ~np.isnan(m)
    low, high = np.full(len(m), -FURTHEST_M), np.full(len(m), FURTHEST_M)
    # In a lane, at least `margin` from both markings; alone, too far from them to be on one.
    least = np.where(on_marking, margin, reach)
    low = np.where(in_lane, np.maximum(low, least - mr), low)
    high = np.where(in_lane, np.minimum(high, -least - ml), high)
    most = np.where(in_lane, reach, margin)
    low = np.where(on_marking, np.maximum(low, -most - m), low)
    high = np.where(on_marking, np.minimum(high, most - m), high)
    outside = on_marking & ((np.isnan(l) & (m > 0)) | (np.isnan(r) & (m < 0)))
    low[outside] = high[outside] = 0.0
    return np.column_stack([low.clip(max=0.0), high.clip(min=0.0)])


def metres_aside(share: NDArray[np.float64], distances: NDArray[np.float32]) -> NDArray[np.float64]:
    """How far (N,) to move to the left, for shares (N,) in [-1, 1] of the room there is."""
    to_the_right, to_the_left = room(distances).T
    metres: NDArray[np.float64] = np.where(share < 0, -share * to_the_right, share * to_the_left)
    return metres
