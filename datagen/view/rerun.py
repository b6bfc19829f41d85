"""Converts a round to a Rerun recording: images with markings, the world in 3D, plots, and the
viewer's layout.

The world frame is the recorded one, z up. Times are in s from the start of the round.
"""

import re
from typing import Any

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from datagen.recording.images import PNG_MAGIC
from datagen.recording.schema.messages import CAMERA_FRAME, EGO
from datagen.view.contents import Contents, Plot

APPLICATION = "driverview"
TIMELINE = "time"
CAR, BODY, CAMERA = "world/car", "world/car/body", "world/car/camera"
IMAGE, MARKINGS = f"{CAMERA}/image", f"{CAMERA}/markings"
TRAFFIC, TRACK, PLOTS = "world/traffic", "world/track", "plots"
ABOUT, CAPTION = "about", "caption"
GREEN, BLUE, GREY = (40, 255, 80), (51, 102, 255), (140, 140, 140)
FROM_CORNER = np.array([[1.0, 0.0, 0.5], [0.0, 1.0, 0.5], [0.0, 0.0, 1.0]])
"""Matrix that shifts pixel coordinates by half a pixel: Rerun's origin is the upper left corner of
the image, not the centre of its first pixel."""
SERIES = ((59, 111, 212), (224, 122, 46), (47, 158, 92), (176, 64, 154), (136, 112, 32))


def log(contents: Contents, recording: rr.RecordingStream) -> None:
    """Send the whole round and the layout of the viewer to `recording`."""
    recording.send_blueprint(layout(contents))
    recording.log(ABOUT, rr.TextDocument(contents.about), static=True)
    recording.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    time = rr.TimeColumn(TIMELINE, duration=contents.steps.times_s)
    _camera(contents, recording, time)
    _world(contents, recording, time)
    for plot in contents.plots:
        _plot(plot, contents.steps.times_s, recording)


def _camera(contents: Contents, recording: rr.RecordingStream, time: rr.TimeColumn) -> None:
    camera = contents.header.camera
    pose = contents.pose(0, CAMERA_FRAME)
    mounting = rr.Transform3D(
        translation=pose.position, quaternion=rr.Quaternion(xyzw=pose.quaternion)
    )
    recording.log(CAMERA, mounting, static=True)
    pinhole = rr.Pinhole(
        image_from_camera=FROM_CORNER @ camera.intrinsics(),
        width=camera.width,
        height=camera.height,
        image_plane_distance=3.0,
    )
    recording.log(CAMERA, pinhole, static=True)
    images = [bytes(step.image) for step in contents.steps]
    kinds = ["image/png" if i.startswith(PNG_MAGIC) else "image/jpeg" for i in images]
    _send(recording, IMAGE, time, rr.EncodedImage.columns(blob=images, media_type=kinds))
    lines = [contents.markings(number) for number in range(len(images))]
    strips = rr.LineStrips2D.columns(strips=[line for step in lines for line in step])
    _send(recording, MARKINGS, time, strips.partition([len(step) for step in lines]))
    recording.log(MARKINGS, rr.LineStrips2D.from_fields(colors=[GREEN], radii=[0.5]), static=True)
    captions = [contents.caption(number) for number in range(len(images))]
    _send(recording, CAPTION, time, rr.TextDocument.columns(text=captions))


def _world(contents: Contents, recording: rr.RecordingStream, time: rr.TimeColumn) -> None:
    numbers = range(len(contents.steps))
    for name, line in contents.scene.items():
        recording.log(
            f"{TRACK}/{_entity_name(name)}", rr.LineStrips3D([line], colors=[GREY]), static=True
        )
    poses = [contents.pose(number) for number in numbers]
    car_poses = rr.Transform3D.columns(
        translation=[pose.position for pose in poses],
        quaternion=[pose.quaternion for pose in poses],
    )
    _send(recording, CAR, time, car_poses)
    body = contents.boxes(0, EGO)
    shape = rr.Boxes3D(
        centers=[box.pose.position for box in body],
        sizes=[box.size for box in body],
        colors=[BLUE],
    )
    recording.log(BODY, shape, static=True)
    cars = [contents.boxes(number) for number in numbers]
    boxes = [box for step in cars for box in step]
    if not boxes:
        return
    columns = rr.Boxes3D.columns(
        centers=[box.pose.position for box in boxes],
        half_sizes=[box.size / 2 for box in boxes],
        quaternions=[box.pose.quaternion for box in boxes],
    )
    _send(recording, TRAFFIC, time, columns.partition([len(step) for step in cars]))
    recording.log(TRAFFIC, rr.Boxes3D.from_fields(colors=[GREY]), static=True)


def _plot(plot: Plot, times: list[float], recording: rr.RecordingStream) -> None:
    for colour, (name, column) in zip(SERIES, plot.series.items(), strict=False):
        entity = f"{plot_entity(plot)}/{name}"
        style = (
            rr.SeriesPoints(names=[name], colors=[colour], marker_sizes=[1.5])
            if plot.dots
            else rr.SeriesLines(names=[name], colors=[colour])
        )
        recording.log(entity, style, static=True)
        present = [(time, value) for time, value in zip(times, column, strict=True)
                   if value is not None]  # fmt: skip
        if present:
            at, shown = np.array(present).T
            time = rr.TimeColumn(TIMELINE, duration=at)
            _send(recording, entity, time, rr.Scalars.columns(scalars=shown))


def _send(recording: rr.RecordingStream, entity: str, time: rr.TimeColumn, columns: Any) -> None:
    rr.send_columns(entity, indexes=[time], columns=columns, recording=recording)


def plot_entity(plot: Plot) -> str:
    """Return the path of the Rerun entity that contains the series of a plot."""
    return f"{PLOTS}/{_entity_name(plot.title)}"


def _entity_name(title: str) -> str:
    """Return `title` in lower case, with `_` for all characters except letters and digits. Other
    characters have a meaning in Rerun's entity paths."""
    return re.sub("[^a-z0-9]+", "_", title.lower())


def layout(contents: Contents) -> rrb.Blueprint:
    """Return the layout of the viewer: images and 3D view left, plots right; the 3D view follows
    the car."""
    plots = [
        rrb.TimeSeriesView(
            origin=plot_entity(plot),
            name=f"{plot.title} ({plot.unit})",
            axis_y=rrb.ScalarAxis(range=plot.limits) if plot.limits else None,
            plot_legend=rrb.PlotLegend(visible=len(plot.series) > 1),
        )
        for plot in contents.plots
    ]
    world = rrb.Spatial3DView(
        origin="world",
        name="World",
        eye_controls=rrb.EyeControls3D(
            position=_camera_position(contents),
            look_target=contents.pose(0).position,
            tracking_entity=CAR,
        ),
    )
    texts = rrb.Horizontal(
        rrb.TextDocumentView(origin=CAPTION, name="Labels"),
        rrb.TextDocumentView(origin=ABOUT, name="Round"),
    )
    camera = contents.header.camera
    image = rrb.Spatial2DView(
        origin=CAMERA,
        name="Driver's view, true markings",
        visual_bounds=rrb.VisualBounds2D(x_range=[0, camera.width], y_range=[0, camera.height]),
    )
    pictures = rrb.Vertical(
        image,
        world,
        texts,
        row_shares=[5, 4, 1],
    )
    return rrb.Blueprint(
        rrb.Horizontal(pictures, rrb.Vertical(*plots), column_shares=[1, 1]),
        rrb.TimePanel(state="collapsed", timeline=TIMELINE),
        collapse_panels=True,
    )


def _camera_position(contents: Contents) -> list[float]:
    """Position of the 3D view's camera: 25 m behind the car at the start and 12 m above it."""
    pose = contents.pose(0)
    x, y, z, w = pose.quaternion.tolist()
    ahead = np.array([1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 0.0])
    return [float(v) for v in pose.position - 25.0 * ahead + np.array([0.0, 0.0, 12.0])]
