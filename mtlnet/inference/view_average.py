"""Averages a model's outputs for several views of an image (test-time augmentation).

The views are the image, the mirrored image, and both turned by `TURN_RAD` to the left and to the
right. The errors of the answers for different views are only partly correlated, so their mean has
smaller errors (docs/experiments/views.md). The model runs once for each view.
"""

from dataclasses import replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

import trackfeatures as tf
from mtlnet.architecture import ABSENT_ABOVE
from mtlnet.inference.prediction import FEATURES, split_outputs
from trackfeatures.camera import CameraParameters
from trackfeatures.errors import UserError

Image = NDArray[np.uint8]
Outputs = NDArray[np.float32]

COUNTS = (1, 2, 6)
"""Numbers of views that can be averaged. 1: the image; 2: also the mirrored image; 6: also both of
these turned to the left and to the right."""
TURN_RAD = 0.04
"""Angle by which the camera is turned, rad. A turned view adds this angle to the answered angle,
and moves the distances. The two directions cancel each other in the mean."""
STD_FACTORS = {1: 1.0, 2: 0.84, 6: 0.74}
"""Ratio of the standard deviation of the mean's error to the mean of the views' standard
deviations, by the number of views. With this factor the share of errors within one standard
deviation is the same as for a single view; measured for the shipped models
(docs/experiments/views.md)."""

_SWAP = {"ml": "mr", "mr": "ml", "l": "r", "r": "l"}
_FROM = [FEATURES.index(_SWAP.get(name, name)) for name in FEATURES]
_MARKINGS_FROM = _FROM[: len(tf.MARKINGS)]


def check_count(count: int) -> None:
    """Raise UserError unless `count` is a number of views that can be averaged: 1, 2 or 6."""
    if count not in COUNTS:
        raise UserError(f"--views {count!r}: give {COUNTS[0]}, {COUNTS[1]} or {COUNTS[2]}")


class Views:
    """Makes `count` views of the images of a camera. Raises UserError for another count than 1, 2
    or 6, and for several views of a camera beside the middle of the car: the mirrored picture is
    that of a camera on the other side."""

    def __init__(self, count: int, camera: CameraParameters) -> None:
        check_count(count)
        if count > 1 and camera.y != 0.0:
            raise UserError(
                f"--views {count}: the model's camera is {camera.y:g} m beside the middle of the "
                "car, where a mirrored picture has other distances; give --views 1"
            )
        self.count = count
        self._camera = camera

    def of(self, image: Image) -> list[Image]:
        """Return the views of `image` (H, W, 3), each of the same shape; every second view is
        mirrored."""
        plain = [image, *(self._turn(image, way) for way in self._turns)]
        if self.count == 1:
            return plain
        return [view for each in plain for view in (each, np.ascontiguousarray(each[:, ::-1]))]

    @cached_property
    def _turns(self) -> list[NDArray[np.float64]]:
        """Homographies (3, 3) of the turned views."""
        if self.count < COUNTS[-1]:
            return []
        camera, degrees = self._camera, np.degrees(TURN_RAD)
        yaws = (camera.yaw_deg - degrees, camera.yaw_deg + degrees)
        return [camera.homography(replace(camera, yaw_deg=float(yaw))) for yaw in yaws]

    def _turn(self, image: Image, homography: NDArray[np.float64]) -> Image:
        import cv2  # imported here: engines of one view, and `--help`, do not need OpenCV

        height, width = image.shape[:2]
        turned = cv2.warpPerspective(
            image, homography, (width, height), borderMode=cv2.BORDER_REPLICATE
        )
        return turned.astype(np.uint8, copy=False)


def mirror_outputs(outputs: Outputs) -> Outputs:
    """Return the outputs (N, K) of left-right mirrored scenes; `split_outputs` explains the K
    columns."""
    mirrored = outputs.copy()
    here, there = split_outputs(outputs), split_outputs(mirrored)
    there.coded[:] = tf.mirror_coded(here.coded)
    there.heading[:] = here.heading[:, ::-1]
    if here.std is not None and there.std is not None:
        there.std[:] = here.std[:, _FROM]
    if here.absent is not None and there.absent is not None:
        there.absent[:] = here.absent[:, _MARKINGS_FROM]
    return mirrored


def mean_outputs(outputs: Outputs) -> Outputs:
    """Return the mean (N, K) of the outputs (V, N, K) for V views of N images, in the order of
    `Views.of`; `split_outputs` explains the K columns.

    All columns are averaged, but for three cases. The mean of the standard deviations is multiplied
    by the factor in `STD_FACTORS`. The mean of a distance does not include views in
    which the marking is absent. A marking is absent if the mean of its probabilities of absence
    exceeds its limit (`ABSENT_ABOVE`); for a model without these probabilities, if it is absent in
    the first view.
    """
    if len(outputs) == 1:
        only: Outputs = outputs[0]
        return only
    back = [mirror_outputs(each) if i % 2 else each for i, each in enumerate(outputs)]
    mean: Outputs = np.mean(back, axis=0, dtype=np.float32)
    parts = split_outputs(mean)
    if parts.std is not None:
        parts.std[:] *= STD_FACTORS[len(outputs)]
    found = np.stack([tf.decode(split_outputs(each).coded)[0] for each in back])
    present = np.isfinite(found)
    total = np.where(present, found, 0.0).sum(0)
    number = present.sum(0)
    if parts.absent is None:
        absent = ~present[0]
    else:
        absent = (parts.absent > np.array(ABSENT_ABOVE, np.float32)) | (number == 0)
    distances = np.where(absent, np.nan, total / np.maximum(number, 1))
    parts.coded[:, :-1] = tf.encode(distances, np.zeros(len(mean)))[:, :-1]
    return mean
