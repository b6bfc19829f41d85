"""Reads what viewers show of a round: images, markings, poses, boxes and series over time.

Frames and units are the same as in the recording; absent values of a series are None.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import trackfeatures as tf
from datagen.recording.errors import DatasetError
from datagen.recording.names import PLACED
from datagen.recording.round_metadata import RoundHeader, summarize_lights
from datagen.recording.schema.messages import EGO, WORLD
from datagen.recording.schema.topics import (
    ANNOTATIONS,
    MESSAGE_TYPES,
    TRACK_SCENE,
    TRAFFIC,
    TRANSFORMS,
)
from datagen.view.steps import Step, Steps, values
from runtime.cli import counted

KMH = 3.6
Series = list[float | None]
Points = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Plot:
    """A plot of series with the same unit. Its axis has the range `limits`; if `limits` is None,
    the range fits the values. With `dots` the values are not joined by lines, because some values
    can be absent."""

    title: str
    unit: str
    series: dict[str, Series]
    dots: bool = False
    limits: tuple[float, float] | None = None


@dataclass(frozen=True, slots=True)
class Pose:
    """Pose of a coordinate frame in its parent frame: `position` (3,) in m and `quaternion` (4,) in
    the order x, y, z, w."""

    position: Points
    quaternion: Points


@dataclass(frozen=True, slots=True)
class Box:
    """A box of `size` (3,) in m with its centre at `pose`."""

    pose: Pose
    size: Points


@dataclass(frozen=True)
class Contents:
    """A round with all its topics. Messages are parsed when they are accessed."""

    steps: Steps

    @staticmethod
    def open(path: Path) -> "Contents":
        """Open the file of a round. Raises DatasetError for a folder or a damaged round."""
        if path.is_dir():
            example = next(iter(sorted(path.glob("rounds/*.mcap"))), path / "rounds/ID.mcap")
            raise DatasetError(f"{path} is a folder; name one of its rounds, such as {example}")
        return Contents(Steps.open(path, tuple(MESSAGE_TYPES)))

    @property
    def header(self) -> RoundHeader:
        return self.steps.index.header

    @property
    def about(self) -> str:
        """Summary of the round in one line."""
        h, frames = self.header, len(self.steps)
        road = f"{counted(h.lanes, 'lane')}, {counted(h.traffic, 'other car')}"
        line = f"{h.id}: {h.track}, {road}, {summarize_lights(h.lights)}, {h.trajectory}"
        if h.trajectory == PLACED:  # no drive: the planned speed and the time have no meaning
            return f"{line}; {counted(frames, 'frame')}"
        return f"{line}, {h.speed_kmh:g} km/h; {frames} frames, {frames / h.frequency_hz:g} s"

    @cached_property
    def plots(self) -> list[Plot]:
        return _plots(list(self.steps))

    def markings(self, number: int) -> list[Points]:
        """True markings in image `number`: polylines (k, 2), x and y in px from the image's upper
        left corner."""
        lines = self.steps.message(ANNOTATIONS, number).points
        return [np.array([(p.x, p.y) for p in line.points]).reshape(-1, 2) for line in lines]

    def caption(self, number: int) -> str:
        return " ".join(t.text for t in self.steps.message(ANNOTATIONS, number).texts)

    def pose(self, number: int, child: str = EGO) -> Pose:
        """Read the pose of the coordinate frame `child` in its parent at step `number`; by default,
        of the car in the world. Raises DatasetError if it was not recorded."""
        for transform in self.steps.message(TRANSFORMS, number).transforms:
            if transform.child_frame_id == child:
                return Pose(_vector(transform.translation), _quaternion(transform.rotation))
        raise DatasetError(f"{self.steps.index.path}: no transform of {child} in step {number}")

    def boxes(self, number: int, frame: str = WORLD) -> list[Box]:
        """Read the boxes of the other cars in the world frame at step `number`. With `frame` EGO:
        the box of the car itself."""
        entities = self.steps.message(TRAFFIC, number).entities
        return [
            Box(Pose(_vector(c.pose.position), _quaternion(c.pose.orientation)), _vector(c.size))
            for entity in entities
            if entity.frame_id == frame
            for c in entity.cubes
        ]

    @cached_property
    def scene(self) -> dict[str, Points]:
        """Markings and edges of the track by name; each is (N, 3) in m in the world frame. {} if a
        recovered round has lost them."""
        if not len(self.steps.index.messages[TRACK_SCENE]):
            return {}
        return {
            entity.id: np.array([(p.x, p.y, p.z) for line in entity.lines for p in line.points])
            for entity in self.steps.message(TRACK_SCENE, 0).entities
        }


def _plots(steps: list[Step]) -> list[Plot]:
    labels = [values(step.labels) for step in steps]
    command = [values(step.command) for step in steps]
    markings = {name: _column(labels, f"to_marking_{name}") for name in tf.MARKINGS}
    offsets = {name: _column(labels, name) for name in ("to_lane_centre", "to_middle")}
    speed: Series = [step.ego.vx * KMH for step in steps]
    heading: Series = [float(step.labels.heading) for step in steps]
    shadow: Series = [step.ego.shadow_fraction for step in steps]
    pedals = {name: _column(command, name) for name in ("steer", "throttle", "brake")}
    return [
        Plot("Distances to markings", "m", markings, dots=True),
        Plot("Offset, left positive", "m", offsets, dots=True),
        Plot("Angle, positive to the right", "rad", {"angle": _column(labels, "angle")}),
        Plot("Heading", "0 left, 1 straight, 2 right", {"heading": heading}, limits=(-0.2, 2.2)),
        Plot("Command, steer left positive", "share", pedals, limits=(-1.1, 1.1)),
        Plot("Speed", "km/h", {"speed": speed}),
        Plot("Road in shadow within 30 m", "share", {"shadow": shadow}, limits=(-0.1, 1.1)),
    ]


def _column(rows: Iterable[dict[str, Any]], name: str) -> Series:
    return [row[name] for row in rows]


def _vector(message: Any) -> Points:
    return np.array([message.x, message.y, message.z])


def _quaternion(message: Any) -> Points:
    return np.array([message.x, message.y, message.z, message.w])
