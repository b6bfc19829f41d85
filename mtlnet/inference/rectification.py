"""Rectifies images of another camera to the model's camera; converts answers back to metres.

Each pixel of the model's view is read from the pixel in which the other camera, with its lens and
mount, sees the same direction in the car's frame. This is exact for any scene, because the optical
centre does not move (Hartley and Zisserman 2004, section 8.4). The rectified picture therefore
looks along the car, whatever the camera's mount. Areas that the camera does not show are grey, as
in training. At another height a camera sees a flat road enlarged or reduced, so answers in metres
are scaled by the ratio of the heights.
"""

from dataclasses import dataclass, replace
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

import trackfeatures as tf
from mtlnet.inference.image_decoding.errors import Fault, ImageError
from mtlnet.inference.out_of_distribution import HEIGHT_SCORE, is_height_seen
from mtlnet.inference.prediction import split_outputs
from runtime.camera_file import read_camera as read_camera  # scripts import it from here
from trackfeatures.camera import CameraParameters
from trackfeatures.coding import OFFSET, SPAN

CAMERA_FILE = "camera.yaml"
LEAST_SHOWN = 0.25
"""Minimum share of the rows, and of the columns, of the model's view that an image must show."""
LEAST_ROAD = 0.1
"""Minimum share of the rows of the model's view below the horizon that an image must show."""
BORDER_LEVEL = 128
"""Grey level of areas that an image does not show. The network's normalisation makes it almost 0,
like the padding of convolutions."""
TOLERANCE = 0.01
OUTSIDE = -1e4  # outside every image, px
KEPT_MAPS = 64  # at least the number of cameras of a service (`serve.cameras`); 0.35 MB each
KEPT_SHARES = 1024

Metres = NDArray[np.float64]


@dataclass(frozen=True)
class Rectification:
    """Converts images of the camera `source` to the view of the camera `target`, and labels and
    outputs between metres at the two cameras. They can be mounted at different positions on the
    car.

    `source` took the images, at any size of its aspect ratio; `target`, without distortion, is the
    model's camera.
    """

    source: CameraParameters
    target: CameraParameters
    any_height: bool = False
    """Whether a camera at any height is in distribution. True for recorded rounds, whose camera
    heights were chosen together with their lane widths."""

    @property
    def scale(self) -> float:
        """Metres at the source per metre at the target, the ratio of the cameras' heights."""
        return self.source.height_above_road_m / self.target.height_above_road_m

    @property
    def view(self) -> CameraParameters:
        """The camera `target`, moved to the position of `source`. It would take the rectified
        images."""
        source = self.source
        return replace(self.target, x=source.x, y=source.y, z=source.z)

    def image(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Rectify an image (H, W, 3) of the source; returns uint8 (target.height, target.width, 3).

        Raises ImageError when the image has another aspect ratio than the source or shows too
        little of the target's view.
        """
        height, width = image.shape[:2]
        source, target = self.source, self.target
        self.check(width, height)
        ratio = target.focal_px / (source.focal_px * height / source.height)
        if ratio < 1:  # reduced by averaging first, because sampling alone would skip pixels
            size = (max(round(width * ratio), 1), max(round(height * ratio), 1))
            image = cv2.resize(image, size, interpolation=cv2.INTER_AREA).astype(np.uint8)
        seen = source.resized(image.shape[1], image.shape[0])
        grey = (BORDER_LEVEL,) * 3
        way = target.homography(seen)
        if seen.distortion == "none" and _is_ahead(target, way):
            found = cv2.warpPerspective(
                image,
                way,
                (target.width, target.height),
                flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
                borderMode=cv2.BORDER_CONSTANT,
                borderValue=grey,
            )
        else:
            coarse, fine = _fixed_maps(seen, target)
            found = cv2.remap(
                image,
                coarse,
                fine,
                cv2.INTER_LINEAR,
                borderMode=cv2.BORDER_CONSTANT,
                borderValue=grey,
            )
        return found.astype(np.uint8, copy=False)

    def check(self, width: int, height: int) -> None:
        """Raise ImageError unless images of this size, px, have the source's aspect ratio and show
        at least a quarter of the target's rows and columns, and a tenth of its rows below the
        horizon."""
        source = self.source
        stretch = width * source.height / (height * source.width)
        if abs(stretch - 1) > TOLERANCE:
            raise ImageError(
                Fault.ASPECT,
                f"the image is {width} x {height} px, its camera gives {source.width} x "
                f"{source.height}: give the camera's whole images, at any size",
            )
        rows, columns, road = shown_shares(source, self.target)
        for share, least, what in (
            (rows, LEAST_SHOWN, "rows"),
            (columns, LEAST_SHOWN, "columns"),
            (road, LEAST_ROAD, "rows below the horizon"),
        ):
            if share < least - TOLERANCE:
                raise ImageError(
                    Fault.FIELD_OF_VIEW,
                    f"the image shows {share:.0%} of the {what} of the model's view "
                    f"({self.target}), at least {least:.0%} must be shown; use a wider lens, or "
                    "one that looks along the road",
                )

    def outputs(self, outputs: NDArray[np.float32]) -> NDArray[np.float32]:
        """Convert a model's outputs (N, K) for rectified images to metres of the car with the
        source camera; returns the converted outputs (N, K).

        Distances and their standard deviations change; the standard deviations then include the
        uncertainty of the source's height. Absent distances stay absent. The angle does not change,
        because the rectified view looks along the car. If the camera is too high or too low
        (`is_height_seen`), all images are marked as out of distribution. `split_outputs` explains
        the K columns.
        """
        changed = outputs.copy()
        parts = split_outputs(changed)
        distances, angle = tf.decode(parts.coded)
        beside_camera = self.scale * (distances + _aside(self.target, angle))
        moved = beside_camera - _aside(self.source, angle)
        coded = OFFSET + SPAN * (moved - _LOW) / _WIDTH
        parts.coded[:, :-1] = np.where(np.isnan(moved), parts.coded[:, :-1], coded)
        if parts.std is not None:
            # d(distance) / d(log height) is the distance beside the camera.
            from_height = self.source.height_std * np.column_stack(
                [beside_camera, tf.localise(beside_camera)]
            )
            own = self.scale * parts.std[:, :-1]
            parts.std[:, :-1] = np.hypot(own, np.nan_to_num(from_height))
        if parts.ood_score is not None and not (self.any_height or is_height_seen(self.scale)):
            parts.ood_score[:] = np.maximum(parts.ood_score, HEIGHT_SCORE)
        return changed

    def labels(self, distances: NDArray[np.float32], angle: NDArray[np.float32]) -> Metres:
        """Return the targets of the distances for rectified images: (N, 5), m at the target camera,
        NaN where absent.

        `distances` (N, 5) m and `angle` (N,) rad are the labels of cars with the source camera.
        `outputs` is the inverse conversion.
        """
        beside_camera = distances + _aside(self.source, angle)
        found: Metres = beside_camera / self.scale - _aside(self.target, angle)
        return found


_LOW = np.array([tf.RANGES[name].lo for name in tf.MARKINGS])
_WIDTH = np.array([tf.RANGES[name].hi for name in tf.MARKINGS]) - _LOW


def _aside(camera: CameraParameters, angle: NDArray[np.floating]) -> Metres:
    """Return the offset (N, 1), m, of a camera to the left of the centre of gravity, across the
    road, for cars that point `angle` (N,) rad to the right of the road."""
    left: Metres = camera.y * np.cos(angle) - camera.x * np.sin(angle)
    return left[:, None]


def _is_ahead(target: CameraParameters, way: Metres) -> bool:
    """Return whether the whole view of `target` is in front of the camera to whose pixels the
    homography `way` (3, 3) leads. A homography also maps directions behind a camera to pixels."""
    right, bottom = target.width - 1, target.height - 1
    corners = np.array([[0, 0, 1], [right, 0, 1], [0, bottom, 1], [right, bottom, 1]])
    return bool((corners @ way[2] > 0).all())


@lru_cache(maxsize=4)  # the two functions below keep what they compute from it
def _maps(source: CameraParameters, target: CameraParameters) -> NDArray[np.float32]:
    """Return column and row (2, H, W), px, of the source's pixel for each pixel of the target;
    `OUTSIDE` where the source shows nothing."""
    columns, rows = np.meshgrid(np.arange(target.width), np.arange(target.height))
    rays = target.rays(np.column_stack([columns.ravel(), rows.ravel()]))
    places = rays @ target.rotation() + (source.x, source.y, source.z)
    found = source.project(places).T.reshape(2, target.height, target.width)
    return np.nan_to_num(found, nan=OUTSIDE).astype(np.float32)


@lru_cache(maxsize=KEPT_MAPS)
def _fixed_maps(
    source: CameraParameters, target: CameraParameters
) -> tuple[NDArray[np.int16], NDArray[np.uint16]]:
    """Return the source's pixel for each pixel of the target, as the fixed-point maps (H, W, 2) and
    (H, W) of cv2.remap."""
    u, v = _maps(source, target)
    coarse, fine = cv2.convertMaps(u, v, cv2.CV_16SC2)
    return coarse.astype(np.int16, copy=False), fine.astype(np.uint16, copy=False)


@lru_cache(maxsize=KEPT_SHARES)
def shown_shares(source: CameraParameters, target: CameraParameters) -> tuple[float, float, float]:
    """Return three shares of the target's view: of its rows, of its columns, and of its rows below
    the horizon of a level road. A row or column counts if the source shows any part of it."""
    u, v = _maps(source, target)
    inside = (u >= -0.5) & (u <= source.width - 0.5) & (v >= -0.5) & (v <= source.height - 0.5)
    rows, columns = inside.any(1), inside.any(0)
    middle = [[(target.width - 1) / 2, row] for row in range(target.height)]
    below = ~np.isnan(target.road_points(middle)[:, 0])
    return float(rows.mean()), float(columns.mean()), float(rows[below].mean())
