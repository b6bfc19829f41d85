"""Makes copies of a labelled picture for evaluation: mirrored, or with the car rotated about the
vertical axis through the camera.

A few drives contain few angles and offsets, so a constant answer scores well on them. Copies widen
the range of angles and offsets. Mirroring is exact. A rotation about the camera's optical centre is
an exact homography of the picture; areas that the picture does not show are grey.
"""

from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

import trackfeatures as tf
from mtlnet.data.labels_file import CustomLabels
from mtlnet.inference.rectification import BORDER_LEVEL
from trackfeatures.camera import CameraParameters
from trackfeatures.coding import UNKNOWN_M
from trackfeatures.errors import UserError

PLAIN, MIRRORED = "plain", "mirrored"
TURNS_RAD = {"turned left": -0.06, "turned right": 0.06}
"""Added to the label's angle by each kind of rotated copy, rad."""
COPIES = (PLAIN, MIRRORED, *TURNS_RAD)
KINDS = {"mirrored": (MIRRORED,), "turned": tuple(TURNS_RAD)}
"""Kinds of copies by the word in `--copies`."""


def parse_copies(text: str) -> tuple[str, ...]:
    """Return the kinds of copies named by `text`, the value of `--copies`, such as
    "mirrored,turned". `PLAIN`, the picture as taken, is always the first.

    Raises UserError for an unknown word.
    """
    words = [word.strip() for word in text.split(",") if word.strip()]
    unknown = [word for word in words if word not in KINDS]
    if unknown:
        raise UserError(f"--copies has {unknown[0]!r}; give some of {', '.join(KINDS)}")
    return (PLAIN, *(copy for word in KINDS if word in words for copy in KINDS[word]))


def copied_camera(camera: CameraParameters, copy: str) -> CameraParameters:
    """Return the camera that would have taken the copy of a picture taken by `camera`. `copy`: one
    of `COPIES`."""
    if copy != MIRRORED:
        return camera
    matrix, coefficients = camera.matrix, list(camera.coefficients)
    if matrix is not None:
        matrix = (matrix[0], matrix[1], camera.width - 1 - matrix[2], matrix[3])
    if camera.distortion == "opencv":
        coefficients[3] = -coefficients[3]  # p2, the horizontal tangential coefficient
    return replace(
        camera,
        y=-camera.y,
        roll_deg=-camera.roll_deg,
        yaw_deg=-camera.yaw_deg,
        matrix=matrix,
        coefficients=tuple(coefficients),
    )


def copied_picture(
    image: NDArray[np.uint8], camera: CameraParameters, copy: str
) -> NDArray[np.uint8]:
    """Return the copy, of kind `copy` (one of `COPIES`), of a picture (H, W, 3) taken by `camera`.
    The picture can have any size of the camera's aspect ratio, which the copy keeps."""
    if copy == PLAIN:
        return image
    if copy == MIRRORED:
        return np.ascontiguousarray(image[:, ::-1])
    camera = camera.resized(image.shape[1], image.shape[0])
    return _turned(image, camera, turned_camera(camera, copy))


def turned_camera(camera: CameraParameters, copy: str) -> CameraParameters:
    """Return the camera of the rotated copy `copy` (a key of `TURNS_RAD`), in the frame of the car
    before its rotation about the vertical axis."""
    return replace(camera, yaw_deg=camera.yaw_deg - float(np.degrees(TURNS_RAD[copy])))


def _turned(
    image: NDArray[np.uint8], camera: CameraParameters, turned: CameraParameters
) -> NDArray[np.uint8]:
    """Return the picture of the camera `turned`, made from the picture of `camera`, which is at the
    same position."""
    size = (camera.width, camera.height)
    grey = (BORDER_LEVEL,) * 3
    if camera.distortion == "none":
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        way = turned.homography(camera)
        found = cv2.warpPerspective(image, way, size, flags=flags, borderValue=grey)
        return found.astype(np.uint8, copy=False)
    columns, rows = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    rays = turned.rays(np.column_stack([columns.ravel(), rows.ravel()]))
    at_place = replace(camera, x=0.0, y=0.0, z=0.0)
    maps = at_place.project(rays @ turned.rotation()).reshape(*columns.shape, 2)
    across, down = (np.nan_to_num(maps[..., i], nan=-1e4).astype(np.float32) for i in (0, 1))
    found = cv2.remap(image, across, down, cv2.INTER_LINEAR, borderValue=grey)
    return found.astype(np.uint8, copy=False)


def copied_label(
    labels: CustomLabels, row: int, camera: CameraParameters, copy: str
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.int64]]:
    """Return distances (1, 5) in m, angle (1,) in rad and class (1,) of the copy, of kind `copy`,
    of picture `row`, which was taken by `camera`."""
    one = labels.take([row])
    distances, angle, heading = one.distances, one.angle, one.heading
    if copy == MIRRORED:
        swapped = -distances[:, [1, 0, 4, 3, 2]]
        distances = np.where(np.isinf(swapped), np.float32(UNKNOWN_M), swapped)
        return distances, -angle, tf.mirror_heading(heading)
    if copy in TURNS_RAD:
        # The camera keeps its position; the centre of gravity moves around it.
        turned = angle + np.float32(TURNS_RAD[copy])
        ahead = np.sin(turned) - np.sin(angle)
        aside = np.cos(turned) - np.cos(angle)
        moved = distances + (camera.x * ahead - camera.y * aside)[:, None]
        return moved.astype(np.float32), turned.astype(np.float32), heading
    return distances, angle, heading
