"""Marking polylines: points on the road plane, in front of the camera and near the image."""

import numpy as np
import pytest
from numpy.typing import ArrayLike

from simulator.arrays import FloatArray
from simulator.camera.core import optics
from simulator.camera.overlay import BEHIND_M, STEP_M, marking_polylines
from simulator.camera.snapshot import standing_pose
from simulator.track.catalogue import find_track
from simulator.track.piece_table import road_points
from simulator.track.road import Road
from trackfeatures.camera import CameraParameters


class Eye:
    """A camera's size and projection, without a renderer."""

    parameters = CameraParameters()
    width, height = parameters.width, parameters.height

    def project(
        self, points: ArrayLike, body_pose: ArrayLike, view: str = "front"
    ) -> tuple[FloatArray, FloatArray]:
        eye = optics.eye_of(self.parameters, body_pose, view)
        return optics.project(eye, self.parameters, points)


@pytest.mark.parametrize("name", ["mountain-pass", "ring-road", "oval"])
def test_road_points_equal_track_at(name: str) -> None:
    track = find_track(name)
    s = np.random.default_rng(1).uniform(-50.0, 2.0 * track.length_m, 200)
    y = np.array([-6.0, 0.0, 2.0])
    points = road_points(track.arrays(), s, y)
    for k, offset in enumerate(y):
        at = track.at(s, offset)
        assert np.allclose(points[k], np.stack([at.x, at.y, at.z], axis=1), rtol=0, atol=1e-9)


@pytest.mark.parametrize("view", ["front", "left", "rear", "top"])
@pytest.mark.parametrize("angle", [0.0, 0.6, 2.0])
def test_polylines_consist_of_consecutive_visible_points(view: str, angle: float) -> None:
    """The polylines equal those of a point-by-point reference implementation."""
    road, eye = Road(find_track("circuit"), 3), Eye()
    pose = standing_pose(road, 150.0, 3.0, angle)
    start, end = (-60.0, BEHIND_M) if view == "rear" else (-BEHIND_M, 60.0)
    start = -60.0 if view in ("left", "top") else start
    expected: list[list[tuple[float, float]]] = []
    for y in road.markings_y:
        run: list[tuple[float, float]] = []
        for s in np.arange(start, end + STEP_M / 2, STEP_M):
            at = road.track.at(150.0 + s, y)
            ((u, v),), (depth,) = eye.project([[at.x, at.y, at.z]], pose, view)
            if depth > 0.24 and -140.5 < u < 419.5 and -140.5 < v < 349.5:
                run.append((u, v))
                continue
            expected += [run] if len(run) >= 2 else []
            run = []
        expected += [run] if len(run) >= 2 else []
    found = marking_polylines(eye, road, (150.0, pose), view=view)
    assert len(found) == len(expected)
    assert expected or angle
    for line, points in zip(found, expected, strict=True):
        assert np.allclose(line, points, rtol=0, atol=1e-6)
