"""A round as one page of HTML that needs nothing beside it: pictures, plan and plots in step."""

import base64
import json
from html import escape
from importlib.resources import files
from math import atan2
from string import Template
from typing import Any

import numpy as np

from datagen.recording.images import PNG_MAGIC
from datagen.view.contents import Contents, Plot, Points, Pose

MOST_FRAMES = 500
"""More are thinned out evenly, so that the page stays below about 15 MB."""


def page(contents: Contents, most: int = MOST_FRAMES) -> str:
    """The page's HTML; plots hold every step, pictures at most `most`."""
    count = len(contents.steps)
    shown = range(0, count, -(-count // most))
    data = {
        "times": contents.steps.times_s,
        "frames": [_frame(contents, number) for number in shown],
        "plots": [_plot(plot) for plot in contents.plots],
        "lines": [_rounded(line[:, :2]) for line in contents.scene.values() if len(line)],
        "size": [contents.header.camera.width, contents.header.camera.height],
    }
    # A closing tag inside a script would end it.
    text = json.dumps(data, separators=(",", ":")).replace("</", "<\\/")
    template = Template(files("datagen.view").joinpath("page.html").read_text(encoding="utf-8"))
    thinned = "" if len(shown) == count else f"; one picture in {shown.step}"
    return template.substitute(
        name=escape(contents.header.id), about=escape(contents.about + thinned), data=text
    )


def _frame(contents: Contents, number: int) -> dict[str, Any]:
    image = bytes(contents.steps[number].image)
    kind = "png" if image.startswith(PNG_MAGIC) else "jpeg"
    return {
        "step": number,
        "image": f"data:image/{kind};base64,{base64.b64encode(image).decode()}",
        "markings": [_rounded(line, 1) for line in contents.markings(number)],
        "caption": contents.caption(number),
        "car": _on_plan(contents.pose(number)),
        "traffic": [_on_plan(box.pose) for box in contents.boxes(number)],
    }


def _on_plan(pose: Pose) -> list[float]:
    """x, y (m) and yaw (rad) in the world."""
    x, y, z, w = pose.quaternion.tolist()
    yaw = atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    return [round(float(pose.position[0]), 2), round(float(pose.position[1]), 2), round(yaw, 3)]


def _plot(plot: Plot) -> dict[str, Any]:
    series = {
        name: [None if value is None else round(value, 4) for value in column]
        for name, column in plot.series.items()
    }
    return {
        "title": plot.title,
        "unit": plot.unit,
        "series": series,
        "dots": plot.dots,
        "limits": plot.limits,
    }


def _rounded(points: Points, digits: int = 2) -> list[float]:
    """x, y, x, y, ..."""
    return [float(value) for value in np.round(points, digits).ravel()]
