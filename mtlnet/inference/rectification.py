"""Images of another camera as the model's camera would take them, and answers in metres again.

A homography turns an image to the pitch and the focal length of the model's camera: exact for any
scene, since the eye stays where it is (Hartley and Zisserman 2004, section 8.4). What the image
does not show is grey, as in half of the training images. A camera at another height sees a flat
road enlarged: what is answered for it in metres is scaled by the ratio of the heights.
"""

from dataclasses import dataclass, fields, replace
from math import cos, radians, sin

import cv2
import numpy as np
from numpy.typing import NDArray

import trackfeatures as tf
from mtlnet.inference.image_decoding.errors import Fault, ImageError
from mtlnet.inference.prediction import split_outputs
from trackfeatures.camera import CameraParameters
from trackfeatures.coding import OFFSET, SPAN

CAMERA_FILE = "camera.yaml"
HEIGHT = "height_above_road_m"
KEYS = (*(field.name for field in fields(CameraParameters)), HEIGHT)
SIDES = ("top", "bottom", "left", "right")
MAX_BORDER = (0.3, 0.3, 0.25, 0.25)
"""Shares of the model's rows and columns that an image need not show, at each of `SIDES`.

In half of the training images as much is hidden at most. A camera with half of the field of view
leaves a quarter of the width empty on each side."""
BORDER_LEVEL = 128
"""Grey level of what an image does not show: nearly 0 to the network, as its padding."""
TOLERANCE = 0.01
MAX_PITCH_DEG = 30.0


@dataclass(frozen=True)
class Rectification:
    """From the images of one camera to those of another, at the same place of the car or not.

    `source` took the images, at any size of its aspect ratio; `target` is the model's camera.
    """

    source: CameraParameters
    target: CameraParameters

    @property
    def scale(self) -> float:
        """Metres beside the source per metre beside the target."""
        return self.source.height_above_road_m / self.target.height_above_road_m

    @property
    def view(self) -> CameraParameters:
        """The camera that takes the rectified images from where the source is."""
        source = self.source
        return replace(self.target, x=source.x, y=source.y, z=source.z)

    def image(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """An image (H, W, 3) of the source as uint8 (target.height, target.width, 3).

        Raises ImageError when it is of another aspect ratio or shows too little.
        """
        height, width = image.shape[:2]
        source, target = self.source, self.target
        stretch = width * source.height / (height * source.width)
        if abs(stretch - 1) > TOLERANCE:
            raise ImageError(
                Fault.ASPECT,
                f"the image is {width} x {height} px, its camera gives {source.width} x "
                f"{source.height}: give the camera's whole images, at any size",
            )
        ratio = target.focal_px / (source.focal_px * height / source.height)
        if ratio < 1:  # averaged first: sampling alone would leave out pixels
            size = (max(round(width * ratio), 1), max(round(height * ratio), 1))
            image = cv2.resize(image, size, interpolation=cv2.INTER_AREA).astype(np.uint8)
        to_source = self._homography(image.shape[1], image.shape[0])
        self._require_shown(to_source, image.shape[1], image.shape[0])
        grey = (BORDER_LEVEL,) * 3
        found = cv2.warpPerspective(
            image,
            to_source,
            (target.width, target.height),
            flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
            borderMode=cv2.BORDER_CONSTANT,
            borderValue=grey,
        )
        return found.astype(np.uint8, copy=False)

    def _homography(self, width: int, height: int) -> NDArray[np.float64]:
        """From pixels of the target to those of a source image so large (3, 3)."""
        source, target = self.source, self.target
        # Pixel centres have whole coordinates.
        focal = np.array([width / source.width, height / source.height]) * source.focal_px
        seen = np.array(
            [[focal[0], 0, (width - 1) / 2], [0, focal[1], (height - 1) / 2], [0, 0, 1]]
        )
        given = np.array(
            [
                [target.focal_px, 0, (target.width - 1) / 2],
                [0, target.focal_px, (target.height - 1) / 2],
                [0, 0, 1],
            ]
        )
        down = radians(source.pitch_deg - target.pitch_deg)
        turn = np.array([[1, 0, 0], [0, cos(down), -sin(down)], [0, sin(down), cos(down)]])
        homography: NDArray[np.float64] = seen @ turn @ np.linalg.inv(given)
        return homography

    def _require_shown(self, to_source: NDArray[np.float64], width: int, height: int) -> None:
        """Raise ImageError when too much of the target's middle row or column is not shown."""
        rows, columns = self.target.height, self.target.width
        down = np.stack([np.full(rows, (columns - 1) / 2), np.arange(rows), np.ones(rows)])
        across = np.stack([np.arange(columns), np.full(columns, (rows - 1) / 2), np.ones(columns)])
        hidden: list[float] = []
        for points in (down, across):
            u, v, depth = to_source @ points
            inside = (depth > 0) & (np.abs(u / depth - (width - 1) / 2) <= width / 2)
            inside &= np.abs(v / depth - (height - 1) / 2) <= height / 2
            shown = np.flatnonzero(inside) if inside.any() else np.array([len(inside)])
            hidden += [shown[0] / len(inside), 1 - (shown[-1] + 1) / len(inside)]
        for share, most, side in zip(hidden, MAX_BORDER, SIDES, strict=True):
            if share > most + TOLERANCE:
                raise ImageError(
                    Fault.FIELD_OF_VIEW,
                    f"the image does not show {share:.0%} of the model's view ({self.target}) at "
                    f"the {side}, at most {most:.0%} may be missing; use a wider lens, or one that "
                    "looks along the road",
                )

    def outputs(self, outputs: NDArray[np.float32]) -> NDArray[np.float32]:
        """A model's outputs (N, 9 to 22) for rectified images, for the car of the source.

        Distances and their standard deviations change; what is absent stays so.
        """
        changed = outputs.copy()
        parts = split_outputs(changed)
        distances, angle = tf.decode(parts.coded)
        beside_camera = distances - self.target.x * np.sin(angle)[:, None]
        beside_camera += self.target.y * np.cos(angle)[:, None]
        moved = self.scale * beside_camera + self.source.x * np.sin(angle)[:, None]
        moved -= self.source.y * np.cos(angle)[:, None]
        spans = [tf.RANGES[name] for name in tf.MARKINGS]
        low = np.array([span.lo for span in spans])
        width = np.array([span.hi for span in spans]) - low
        coded = OFFSET + SPAN * (moved - low) / width
        parts.coded[:, :-1] = np.where(np.isnan(moved), parts.coded[:, :-1], coded)
        if parts.std is not None:
            parts.std[:, :-1] *= np.float32(self.scale)
        return changed
