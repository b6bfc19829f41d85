"""The film of a drive: the driver's view with true and perceived markings, and driving curves.

The driver's view is on the left, a top view of the same markings on the right. The curves below
show the offset and the angle in the last 15 s. True values are green, perceived values orange.
"""

from collections import deque
from typing import TYPE_CHECKING

import cv2
import numpy as np
from numpy.typing import NDArray

from controllers.perception.perceived import Perceived
from controllers.perception.sources import CameraPerception
from mtlnet.inference.overlay import PREDICTION_COLOUR, TRUTH_COLOUR, Distances, draw_overlay
from runtime.film import Mp4Writer

if TYPE_CHECKING:
    from simulator.camera import Camera
    from simulator.world.world import World

Image = NDArray[np.uint8]

CURVE_S = 15.0  # s of driving that the curves show
CURVE_HEIGHT = 90  # px
OFFSET_SPAN_M, ANGLE_SPAN_RAD = 1.0, 0.1
"""Absolute values at the upper and lower edges of the curves' images. Larger values are drawn at
the edge."""
NOTHING: tuple[Distances, float] = ({}, 0.0)
"""The perceived markings and angle of a drive without a model: no markings, so that the film shows
only the true ones."""
TEXT_COLOUR, GRID_COLOUR, BACK = (235, 235, 235), (90, 90, 96), 24


class DriveFilm:
    """Draws a picture for each control step and writes it to the video file `film`.

    If the drive has a camera perception, `perception`, the picture shows its image and its answer.
    If `perception` is None, `camera` renders the image, and only the true markings are drawn.
    """

    def __init__(
        self,
        film: Mp4Writer,
        world: "World",
        camera: "Camera",
        perception: CameraPerception | None = None,
        *,
        lane_centre: float = 0.0,
    ) -> None:
        self._film, self._world, self._camera = film, world, camera
        self._perception, self._lane_centre = perception, lane_centre
        length = round(CURVE_S * world.frequency_hz)
        self._curves: deque[tuple[float, float, float, float]] = deque(maxlen=length)

    def add(self, perceived: Perceived, steer: float) -> None:
        """Draw the present step, with the perceived road and the steering action."""
        now, world = self._world.state, self._world
        features = world.features()
        offset = now.to_middle - self._lane_centre
        seen = np.nan if perceived.to_lane_centre is None else perceived.to_lane_centre
        self._curves.append((offset, seen, now.angle, perceived.angle))
        truth = (features.distances, features.angle)
        answer: tuple[Distances, float]
        if self._perception is None or self._perception.image is None:
            image, answer = self._render(), NOTHING
        else:
            image, found = self._perception.image, self._perception.answer
            answer = (found["distances_m"], float(found["angle_rad"]))
        view = draw_overlay(image, self._camera.parameters, now.curvature, truth, answer)
        text = (
            f"{now.time_s:6.2f} s  {now.speed_kmh:5.1f} km/h  steer {steer:+.3f}  "
            f"d {offset:+.3f} m  angle {now.angle:+.4f} rad  lap {now.lap}"
        )
        strip = self._draw_curves(view.shape[1])
        self._film.write(np.vstack([view, caption(text, view.shape[1]), strip]))

    def _render(self) -> Image:
        world = self._world
        image: Image = self._camera.render(world.body_pose(), world.traffic.poses())
        return image

    def _draw_curves(self, width: int) -> Image:
        values = np.array(self._curves)
        length = self._curves.maxlen or len(values)
        strips = (
            curves(values[:, :2], length, width, OFFSET_SPAN_M, "offset, 1 m"),
            curves(values[:, 2:], length, width, ANGLE_SPAN_RAD, "angle, 0.1 rad"),
        )
        return np.vstack(strips)


def caption(text: str, width: int) -> Image:
    """Draw a line of text on a dark strip; return the RGB image (28, width, 3)."""
    strip = np.full((28, width, 3), BACK, np.uint8)
    cv2.putText(strip, text, (10, 20), cv2.FONT_HERSHEY_SIMPLEX, 0.5, TEXT_COLOUR, 1, cv2.LINE_AA)
    return strip


def curves(values: NDArray[np.float64], length: int, width: int, span: float, title: str) -> Image:
    """Draw a curve of the true and one of the perceived `values` (n, 2); return an RGB image (90,
    width, 3).

    The image has room for `length` control steps, and the last step is at its right edge. `span` is
    the value at the upper edge, in the unit of `values`; up is positive (left). NaN leaves a gap.
    `title` is written into the image.
    """
    strip = np.full((CURVE_HEIGHT, width, 3), BACK, np.uint8)
    middle = CURVE_HEIGHT // 2
    cv2.line(strip, (0, middle), (width, middle), GRID_COLOUR, 1)
    place = (10, CURVE_HEIGHT - 8)
    cv2.putText(strip, title, place, cv2.FONT_HERSHEY_SIMPLEX, 0.4, GRID_COLOUR, 1, cv2.LINE_AA)
    x = width - 1 - (len(values) - 1 - np.arange(len(values))) * width / length
    # The true curve is drawn last, so that it covers the perceived curve where both are equal.
    for column, colour in ((1, PREDICTION_COLOUR), (0, TRUTH_COLOUR)):
        shown = np.isfinite(values[:, column])
        y = middle - np.clip(values[:, column] / span, -1.0, 1.0) * (middle - 4)
        points = np.column_stack([x, np.where(shown, y, 0.0)]).round().astype(np.int32)
        for run in np.split(np.arange(len(values)), np.flatnonzero(np.diff(shown)) + 1):
            if len(run) and shown[run[0]]:
                cv2.polylines(strip, [points[run]], False, colour, 1, cv2.LINE_AA)
    return strip
