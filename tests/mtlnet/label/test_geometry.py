"""Markings dragged onto a picture: projected ones are read back; impossible ones are refused."""

from dataclasses import replace

import numpy as np
import pytest

from mtlnet.label.geometry import Markings, MarkingsError, fit_markings, handles, marking_pixels
from trackfeatures.camera import CameraParameters

CAMERAS = [
    CameraParameters(width=640, height=360, fov_y_deg=32.75, x=0.0, z=0.97, pitch_deg=1.5),
    CameraParameters(),
    CameraParameters(
        width=1280,
        height=720,
        x=1.2,
        y=0.15,
        z=1.1,
        pitch_deg=3.0,
        roll_deg=1.0,
        yaw_deg=-2.0,
        matrix=(900.0, 910.0, 655.0, 350.0),
        distortion="opencv",
        coefficients=(-0.2, 0.05, 0.001, -0.001, 0.0),
    ),
]
MARKINGS = Markings(-1.62, 1.95, 0.031, 0.0021, 1.2)


@pytest.mark.parametrize("camera", CAMERAS)
def test_markings_that_are_projected_are_read_back(camera: CameraParameters) -> None:
    left, right = marking_pixels(camera, MARKINGS, [6.0, 12.0, 28.0])
    found = fit_markings(camera, left, right, curvature=None)
    assert found.ml == pytest.approx(MARKINGS.ml, abs=1e-3)
    assert found.mr == pytest.approx(MARKINGS.mr, abs=1e-3)
    assert found.angle == pytest.approx(MARKINGS.angle, abs=1e-4)
    assert found.curvature == pytest.approx(MARKINGS.curvature, abs=1e-5)
    assert found.pitch_deg == pytest.approx(MARKINGS.pitch_deg, abs=1e-3)
    # Two points of each are enough where the curvature is known, at different distances, too.
    left, _ = marking_pixels(camera, MARKINGS, [7.0, 20.0])
    _, right = marking_pixels(camera, MARKINGS, [9.0, 33.0])
    found = fit_markings(camera, left, right, MARKINGS.curvature)
    np.testing.assert_allclose([found.ml, found.mr, found.angle], [-1.62, 1.95, 0.031], atol=1e-3)
    # ... and a third point of one side gives the curvature.
    left, _ = marking_pixels(camera, MARKINGS, [7.0, 20.0, 12.0])
    found = fit_markings(camera, left, right, None)
    assert found.curvature == pytest.approx(MARKINGS.curvature, abs=1e-5)


def test_the_pitch_of_the_camera_is_kept_where_it_is_given() -> None:
    camera = CAMERAS[0]
    seen = marking_pixels(camera, replace(MARKINGS, curvature=0.0), [6.0, 20.0])
    found = fit_markings(camera, *seen, pitch_deg=1.2)
    assert (found.pitch_deg, found.curvature) == (1.2, 0.0)
    assert found.mr - found.ml == pytest.approx(3.57, abs=1e-6)
    # With another pitch the markings are no longer parallel: the least squares lie between.
    other = fit_markings(camera, *seen, pitch_deg=1.6)
    assert other.pitch_deg == 1.6
    assert other.mr - other.ml == pytest.approx(3.57, abs=0.3)
    assert abs(other.mr - other.ml - 3.57) > 0.01


def test_a_pixel_to_the_side_is_worth_what_the_ground_is_there() -> None:
    """At 10 m one pixel of a focal length of 612 px is 16 mm."""
    camera = replace(CAMERAS[0], pitch_deg=0.0)
    straight = Markings(-1.8, 1.8, 0.0, 0.0, 0.0)
    left, right = marking_pixels(camera, straight, [10.0, 20.0])
    left[:, 0] += [1.0, 0.5]  # the whole marking 10 / f to the right
    found = fit_markings(camera, left, right, pitch_deg=0.0)
    assert found.ml == pytest.approx(-1.8 + 10 / camera.focal_px, abs=1e-6)
    assert found.mr == pytest.approx(1.8, abs=1e-6)


def test_handles_lie_on_the_markings_and_in_the_picture() -> None:
    for camera in CAMERAS:
        found = handles(camera, MARKINGS)
        for side in ("left", "right"):
            (_, near), (_, middle), (_, far) = found[side]
            assert 0 < far < middle < near < camera.height
        again = fit_markings(camera, found["left"], found["right"], curvature=None)
        assert again.ml == pytest.approx(MARKINGS.ml, abs=1e-3)
    aside = handles(CAMERAS[0], replace(MARKINGS, ml=-5.4, mr=-1.9))
    u, v = np.array(aside["left"]).T
    assert ((u >= 0) & (u <= 639) & (v >= 0) & (v <= 359)).all()


def test_points_that_are_no_markings_are_refused() -> None:
    camera = CAMERAS[0]
    left, right = marking_pixels(camera, MARKINGS, [6.0, 20.0])
    with pytest.raises(MarkingsError, match="each marking needs two points"):
        fit_markings(camera, left[:1], right)
    with pytest.raises(MarkingsError, match="at or above the horizon"):
        fit_markings(camera, [[100.0, 300.0], [200.0, 20.0]], right, pitch_deg=1.5)
    with pytest.raises(MarkingsError, match=r"do not meet ahead|meet where a|above the horizon"):
        fit_markings(camera, [[300.0, 300.0], [100.0, 250.0]], [[310.0, 300.0], [600.0, 250.0]])
