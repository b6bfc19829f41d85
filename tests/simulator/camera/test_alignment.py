"""Rendered markings coincide with the projected track geometry in bends, on hills and on banks."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from simulator.camera import Camera, Light
from simulator.camera.snapshot import standing_pose
from simulator.track.catalogue import find_track
from simulator.track.markings import MarkingStyle
from simulator.track.road import Road
from trackfeatures.camera import CameraParameters

FloatArray = NDArray[np.float64]

NEAREST_M, FARTHEST_M = 3.0, 30.0
LIMIT_PX = 1.5


def _profile(grey: FloatArray, centre: FloatArray, normal: FloatArray, reach: float) -> FloatArray:
    """(n, 2): offset along `normal` (pixels) and brightness there, bilinear."""
    steps = np.arange(-reach, reach + 0.01, 0.25)
    u = centre[0] + steps * normal[0]
    v = centre[1] + steps * normal[1]
    i, j = np.floor(v).astype(int), np.floor(u).astype(int)
    fv, fu = v - i, u - j
    top = grey[i, j] * (1 - fu) + grey[i, j + 1] * fu
    low = grey[i + 1, j] * (1 - fu) + grey[i + 1, j + 1] * fu
    return np.stack([steps, top * (1 - fv) + low * fv], axis=1)


def _errors(camera: Camera, bare: Camera, pose: FloatArray, s: float) -> FloatArray:
    """Distances (pixels) from the true outer markings to the centres of the painted lines; NaN
    where no paint is visible within 0.4 m of the true marking.

    Paint is the difference between the images of `camera` and of `bare`, whose road has no paint.
    """
    road = camera.road
    difference = camera.render(pose).astype(np.float64) - bare.render(pose)
    grey = np.abs(difference).sum(axis=2)
    distances = s + np.arange(NEAREST_M, FARTHEST_M + 2.0, 0.5)
    lines = []
    for y in road.markings_y:
        place = road.track.at(s + np.arange(0.0, 3 * FARTHEST_M, 0.5), y)
        lines.append(camera.project(np.stack([place.x, place.y, place.z], axis=1), pose)[0])
    found = []
    for line in (0, len(lines) - 1):
        y = road.markings_y[line]
        others = np.concatenate([each for k, each in enumerate(lines) if k != line])
        place = road.track.at(distances, y)
        points = np.stack([place.x, place.y, place.z], axis=1)
        pixels, depth = camera.project(points, pose)
        for k in range(len(points) - 1):
            along = pixels[k + 1] - pixels[k]
            if not (2.0 < depth[k] < FARTHEST_M) or np.hypot(*along) < 0.3:
                continue
            normal = np.array([-along[1], along[0]]) / np.hypot(*along)
            reach = float(np.clip(0.4 * camera.intrinsics[0, 0] / depth[k], 2.5, 10.0))
            low, high = pixels[k] - reach - 2.0, pixels[k] + reach + 2.0
            inside = high[0] < camera.width and high[1] < camera.height
            if not (low.min() > 0 and inside):
                continue
            own = np.abs(np.arange(len(lines[line])) - (k + NEAREST_M / 0.5)) > 8
            beside = np.concatenate([others, lines[line][own]])
            if np.nanmin(np.hypot(*(beside - pixels[k]).T)) < reach + 1.5:
                continue  # the profile would hold the paint of another place
            profile = _profile(grey, pixels[k], normal, reach)
            offset, paint = profile.T
            seen = paint.max() > 12.0
            found.append(abs(float((paint * offset).sum() / paint.sum())) if seen else np.nan)
    return np.array(found)


@pytest.mark.parametrize(
    ("name", "kind"),
    [
        ("mountain-pass", "overcast"),
        ("oval", "overcast"),
        ("circuit", "overcast"),
        ("town", "overcast"),
        ("mountain-pass", "rain"),
        ("town", "rain"),
    ],
)
def test_rendered_paint_coincides_with_projected_markings(name: str, kind: str) -> None:
    painted = replace(find_track(name), markings=MarkingStyle())
    unpainted = replace(painted, markings=MarkingStyle(line_width=1e-6))
    rng = np.random.default_rng(5)
    light = Light.named(kind, rng)
    errors = []
    for lanes in (1, 2):
        road = Road(painted, lanes)
        with (
            Camera(road, seed=2, light=light) as camera,
            Camera(Road(unpainted, lanes), seed=2, light=light) as bare,
        ):
            for s in rng.uniform(0.0, painted.length_m, 40):
                pose = standing_pose(road, s, rng.uniform(-1.2, 1.2), rng.normal(0.0, 0.05))
                errors.append(_errors(camera, bare, pose, s))
    found = np.concatenate(errors)
    seen = found[~np.isnan(found)]
    assert len(found) > 1000
    # Crests hide part of the road.
    assert len(seen) > 0.9 * len(found)
    assert np.median(seen) < 0.15
    # Where a line turns away along the line of sight its centre is not well defined.
    assert np.percentile(seen, 99.5) < LIMIT_PX


def _random_camera(rng: np.random.Generator) -> CameraParameters:
    """A distorted lens of 50 to 90 degrees, off-centre, mounted askew."""
    width, height = 480, 320
    focal = width / 2 / np.tan(np.radians(rng.uniform(25, 45)))
    if rng.random() < 0.5:
        kind, lens = (
            "opencv",
            (rng.uniform(-0.3, 0.15), rng.uniform(0.0, 0.08), *rng.normal(0, 1e-3, 2)),
        )
    else:
        kind, lens = "fisheye", (rng.uniform(-0.05, 0.02), *rng.normal(0.0, 0.003, 3))
    centre = rng.uniform(-20, 20, 2) + np.array([(width - 1) / 2, (height - 1) / 2])
    pitch, roll, yaw = rng.uniform([-3, -4, -8], [6, 4, 8])
    x, y, z = rng.uniform([0.2, -0.4, 0.7], [1.5, 0.4, 1.6])
    return CameraParameters(
        width, height, x=x, y=y, z=z, pitch_deg=pitch, roll_deg=roll, yaw_deg=yaw,
        matrix=(focal, focal * rng.uniform(0.97, 1.03), *centre.tolist()),
        distortion=kind, coefficients=tuple(map(float, lens)),
    )  # fmt: skip


@pytest.mark.parametrize(
    "number", [0, *(pytest.param(k, marks=pytest.mark.extended) for k in range(1, 10))]
)
def test_markings_lie_on_paint_through_ten_random_lenses(number: int) -> None:
    painted = replace(find_track("circuit"), markings=MarkingStyle())
    unpainted = replace(painted, markings=MarkingStyle(line_width=1e-6))
    rng = np.random.default_rng([9, number])
    light = Light.named("overcast", rng)
    lens = _random_camera(rng)
    with (
        Camera(Road(painted, 2), lens, seed=2, light=light) as camera,
        Camera(Road(unpainted, 2), lens, seed=2, light=light) as bare,
    ):
        errors = []
        for s in rng.uniform(0.0, painted.length_m, 4):
            pose = standing_pose(camera.road, s, rng.uniform(-1.2, 1.2), rng.normal(0.0, 0.05))
            errors.append(_errors(camera, bare, pose, s))
    found = np.concatenate(errors)
    seen = found[~np.isnan(found)]
    assert len(seen) > 100
    assert len(seen) > 0.9 * len(found)
    assert np.median(seen) < 0.1
    # Where a line turns away along the line of sight its centre is not well defined.
    assert np.percentile(seen, 98) < 1.0
