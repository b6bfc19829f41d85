"""Reads the camera of a recording's pictures from ROS `CameraInfo` or Foxglove `CameraCalibration`.

These messages state matrix and distortion; the mount on the car is taken from the model's camera.
Sources: ROS `sensor_msgs/CameraInfo`, REP 104 of image_pipeline, Foxglove's schema.
"""

from dataclasses import replace
from pathlib import PurePosixPath
from typing import Any

import numpy as np

from mtlnet.sources.recordings.images import CALIBRATION, ROS_CALIBRATION
from mtlnet.sources.recordings.topic import Topic
from runtime.camera_file import MODELS, read_distortion
from trackfeatures.camera import CameraError, CameraParameters
from trackfeatures.errors import UserError

CALIBRATIONS = (ROS_CALIBRATION, CALIBRATION)
RECTIFIED = "image_rect"
"""Part of the name of a topic whose pictures follow the projection matrix, without distortion (REP
104)."""
SAME_PX = 0.01
MAX_NUMBER = 1e6  # limit of a matrix (px) or a distortion; damaged files exceed it


def calibration_topic(image_topic: str, topics: list[Topic]) -> Topic | None:
    """Return the calibration topic for an image topic: the topic directly below the image topic's
    name, or in the nearest enclosing namespace.

    Returns None if there is no calibration topic, or if the nearest namespace has several.
    """
    image = PurePosixPath(image_topic)
    places = [image, *image.parents]
    near: dict[int, list[Topic]] = {}
    for topic in topics:
        parent = PurePosixPath(topic.name).parent
        if topic.schema in CALIBRATIONS and parent in places:
            near.setdefault(places.index(parent), []).append(topic)
    best = near[min(near)] if near else []
    return best[0] if len(best) == 1 else None


def camera_of(message: Any, image_topic: str, mount: CameraParameters) -> CameraParameters:
    """Return the camera that a calibration message describes, with position and angles of the
    camera `mount`.

    `message`: a ROS `CameraInfo` or Foxglove `CameraCalibration`. `image_topic`: name of the topic
    of the pictures; if it contains `image_rect`, the projection matrix describes them. Raises
    UserError if the message has no calibration, or an unsupported lens model.
    """
    is_ros = hasattr(message, "header")
    names = "dkp" if is_ros else "DKP"
    distortion, matrix, projection = (np.asarray(getattr(message, n), float) for n in names)
    if RECTIFIED in image_topic and projection.size == 12:
        matrix, distortion = projection.reshape(3, 4)[:, :3], np.zeros(0)
    if matrix.size != 9 or not np.isfinite(matrix).all() or not matrix.ravel()[0] > 0:
        raise UserError("it is not calibrated: its matrix K has no focal length")
    if is_ros and (_is_part(message) or max(_binning(message)) > 1):
        raise UserError("its pictures are a part (roi) or are binned, which is not read")
    if not max(map(np.abs, (*matrix.ravel(), *distortion))) <= MAX_NUMBER:
        raise UserError(f"one of its numbers is no number, or above {MAX_NUMBER:g}")
    fx, _, cx, _, fy, cy, *_ = matrix.ravel().tolist()
    try:
        return replace(
            mount,
            width=int(message.width),
            height=int(message.height),
            matrix=(fx, fy, cx, cy),
            **_lens(str(message.distortion_model), distortion),
        )
    except CameraError as error:
        raise UserError(str(error)) from error


def is_models(camera: CameraParameters, model: CameraParameters) -> bool:
    """Return whether a camera has the model's matrix and size and no distortion, so that its
    pictures can be used unchanged."""
    same_size = (camera.width, camera.height) == (model.width, model.height)
    matrices = camera.intrinsics(), model.intrinsics()
    return camera.distortion == "none" and same_size and np.allclose(*matrices, atol=SAME_PX)


def _lens(model: str, distortion: Any) -> dict[str, Any]:
    is_fisheye = MODELS.get(model.lower()) == "fisheye"  # with all coefficients 0: r = f * angle
    if not distortion.size or not (is_fisheye or distortion.any()):
        return {"distortion": "none", "coefficients": ()}
    return read_distortion(model, distortion.tolist())


def _is_part(message: Any) -> bool:
    """Return whether a ROS CameraInfo describes a part of the camera's picture. Its `roi` is 0 or
    the full size otherwise."""
    roi = message.roi
    size = int(roi.width), int(roi.height)
    full = (0, 0), (int(message.width), int(message.height))
    return size not in full or bool(roi.x_offset or roi.y_offset)


def _binning(message: Any) -> tuple[int, int]:
    return int(message.binning_x), int(message.binning_y)
