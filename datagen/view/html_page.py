"""Shows a recorded round as one self-contained HTML page: images, map and plots at the same time.

Positions are in m in the world frame, angles in rad, markings in pixels of the image.
"""

from dataclasses import asdict
from math import atan2
from typing import Any

import numpy as np

from datagen.recording.images import PNG_MAGIC
from datagen.view.contents import Contents, Plot, Points, Pose
from runtime.html import data_uri, render

MAX_FRAMES = 500
"""Largest number of images on the page. Longer rounds are subsampled evenly, so that the page stays
below about 15 MB."""


def page(contents: Contents, max_frames: int = MAX_FRAMES) -> str:
    """Return the HTML of the page. The plots have every step, but at most `max_frames` images are
    shown."""
    count = len(contents.steps)
    shown = range(0, count, -(-count // max_frames))
    data = {
        "times": contents.steps.times_s,
        "frames": [_frame(contents, number) for number in shown],
        "plots": [_plot(plot) for plot in contents.plots],
        "lines": [_flatten(line[:, :2]) for line in contents.scene.values() if len(line)],
        "size": [contents.header.camera.width, contents.header.camera.height],
    }
    subsampled = "" if len(shown) == count else f"; one image in {shown.step} steps"
    about = contents.about + subsampled
    return render("datagen.view", "page.html", name=contents.header.id, about=about, data=data)


def _frame(contents: Contents, number: int) -> dict[str, Any]:
    image = bytes(contents.steps[number].image)
    media_type = "image/png" if image.startswith(PNG_MAGIC) else "image/jpeg"
    return {
        "step": number,
        "image": data_uri(image, media_type),
        "markings": [_flatten(line, 1) for line in contents.markings(number)],
        "caption": contents.caption(number),
        "car": _planar_pose(contents.pose(number)),
        "traffic": [_planar_pose(box.pose) for box in contents.boxes(number)],
    }


def _planar_pose(pose: Pose) -> list[float]:
    """Position x, y (m) and yaw (rad) of `pose`, rounded."""
    x, y, z, w = pose.quaternion.tolist()
    yaw = atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    return [round(float(pose.position[0]), 2), round(float(pose.position[1]), 2), round(yaw, 3)]


def _plot(plot: Plot) -> dict[str, Any]:
    series = {
        name: [None if value is None else round(value, 4) for value in column]
        for name, column in plot.series.items()
    }
    return asdict(plot) | {"series": series}


def _flatten(points: Points, digits: int = 2) -> list[float]:
    """The points (N, 2) as a flat list x, y, x, y, ..., rounded to `digits` decimals."""
    return [float(value) for value in np.round(points, digits).ravel()]
