"""Lens and mount of a camera compared with OpenCV; points on the road against closed forms."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from trackfeatures import UserError
from trackfeatures.camera import CameraError, CameraParameters
from trackfeatures.lens import angle_limit

MOUNT = {"x": 1.2, "y": 0.1, "z": 1.1, "pitch_deg": 5.0, "roll_deg": 3.0, "yaw_deg": -4.0}
MATRIX = (700.0, 720.0, 655.0, 340.0)
LENSES = [
    ("none", ()),
    ("opencv", (-0.3, 0.1, 0.001, -0.002)),
    ("opencv", (-0.35, 0.15, 0.001, -0.0005, -0.03)),
    ("opencv", (0.2, 0.05, 0.0, 0.0)),
    ("opencv", (0.9, 0.3, 0.0003, -0.0004, 0.02, 1.2, 0.5, 0.05)),
    ("fisheye", (0.0, 0.0, 0.0, 0.0)),
    ("fisheye", (-0.02, 0.005, -0.003, 0.0006)),
]


def camera_of(kind: str, coefficients: tuple[float, ...]) -> CameraParameters:
    lens = {"distortion": kind, "coefficients": coefficients}
    return CameraParameters(1280, 720, matrix=MATRIX, **MOUNT, **lens)  # type: ignore[arg-type]


def by_opencv(camera: CameraParameters, points: NDArray[np.float64]) -> NDArray[np.float64]:
    turn = camera.rotation()
    place = -turn @ np.array([camera.x, camera.y, camera.z])
    turned, _ = cv2.Rodrigues(turn)
    k, d = camera.intrinsics(), np.array(camera.coefficients or (0.0,) * 4)
    project = cv2.fisheye.projectPoints if camera.distortion == "fisheye" else cv2.projectPoints
    pixels, _ = project(points[:, None], turned, place, k, d)
    return np.asarray(pixels, np.float64).reshape(-1, 2)


@pytest.mark.parametrize(("kind", "coefficients"), LENSES)
def test_pixels_are_those_of_opencv_and_lead_back(
    kind: str, coefficients: tuple[float, ...]
) -> None:
    camera = camera_of(kind, coefficients)
    points = np.random.default_rng(0).uniform([3, -3, -1.3], [40, 3, 2], (500, 3))
    pixels = camera.project(points)
    seen = ~np.isnan(pixels[:, 0])
    assert seen.sum() > 490
    assert np.abs(pixels - by_opencv(camera, points))[seen].max() < 1e-6
    rays = camera.rays(pixels[seen])
    away = (points[seen] - (camera.x, camera.y, camera.z)) @ camera.rotation().T
    assert np.abs(rays - away / away[:, 2:]).max() < 1e-9


@pytest.mark.parametrize(("kind", "coefficients"), LENSES)
def test_every_pixel_has_a_ray_that_leads_back_or_none(
    kind: str, coefficients: tuple[float, ...]
) -> None:
    camera = camera_of(kind, coefficients)
    columns, rows = np.meshgrid(np.arange(0, 1280, 7.0), np.arange(0, 720, 7.0))
    pixels = np.column_stack([columns.ravel(), rows.ravel()])
    rays = camera.rays(pixels)
    seen = ~np.isnan(rays[:, 0])
    assert seen.mean() > 0.9
    points = rays @ camera.rotation() + (camera.x, camera.y, camera.z)
    assert np.abs(camera.project(points) - pixels)[seen].max() < 1e-6


def test_a_lens_that_folds_is_used_up_to_its_fold() -> None:
    """r (1 - 0.25 r^2) has its maximum 4 / (3 sqrt(3)) = 0.7698 at r = 2 / sqrt(3)."""
    camera = CameraParameters(201, 201, matrix=(100, 100, 100, 100), x=0, z=0,
                              distortion="opencv", coefficients=(-0.25, 0, 0, 0))  # fmt: skip
    fold = 2 / np.sqrt(3)
    assert angle_limit("opencv", camera.coefficients) == pytest.approx(np.arctan(fold))
    inside, outside = camera.project([[1, -fold + 1e-3, 0], [1, -fold - 1e-3, 0]])
    assert inside[0] == pytest.approx(100 + 76.98, abs=0.01)
    assert np.isnan(outside).all()
    x = camera.rays([[100 + 76.0, 100]])[0, 0]
    assert x < fold
    assert x - x**3 / 4 == pytest.approx(0.76, abs=1e-9)
    assert np.isnan(camera.rays([[100 + 77.5, 100]])[0, 0])


def test_behind_the_camera_there_is_no_pixel() -> None:
    for kind, coefficients in LENSES:
        assert np.isnan(camera_of(kind, coefficients).project([[-5.0, 0.0, 0.0]])).all()


def test_the_mount_by_hand() -> None:
    """Positive yaw moves a point ahead of the car to the right in the image. Positive pitch moves
    the horizon up. Positive roll raises the right end of the horizon in the image."""
    camera = CameraParameters(201, 201, matrix=(100, 100, 100, 100), x=0, z=0)
    ahead = [[1000.0, 0.0, 0.0]]
    turned = replace(camera, yaw_deg=10.0).project(ahead)[0]
    np.testing.assert_allclose(turned, [100 + 100 * np.tan(np.radians(10)), 100])
    down = replace(camera, pitch_deg=10.0).project(ahead)[0]
    np.testing.assert_allclose(down, [100, 100 - 100 * np.tan(np.radians(10))])
    rolled = replace(camera, roll_deg=10.0).project([[1000.0, -1000.0, 0.0]])[0]
    np.testing.assert_allclose(
        rolled, [100 + 100 * np.cos(np.radians(10)), 100 - 100 * np.sin(np.radians(10))]
    )


def test_road_points_by_hand_and_back() -> None:
    """A ray 45 degrees below the horizon from 1.5 m height meets the road 1.5 m ahead."""
    camera = CameraParameters(201, 201, matrix=(100, 100, 100, 100), x=0.75, y=0.2, z=1.25)
    np.testing.assert_allclose(camera.road_points([[100, 200]]), [[2.25, 0.2]])
    np.testing.assert_allclose(camera.road_points([[0, 200]]), [[2.25, 1.7]])
    assert np.isnan(camera.road_points([[100, 100], [100, 50]])).all()
    for kind, coefficients in LENSES:
        mounted = camera_of(kind, coefficients)
        places = np.random.default_rng(1).uniform([4, -4], [30, 4], (100, 2))
        pixels = mounted.project(np.column_stack([places, np.full(100, -camera.cg_height_m)]))
        seen = ~np.isnan(pixels[:, 0])
        np.testing.assert_allclose(mounted.road_points(pixels)[seen], places[seen], atol=1e-6)


def test_a_resized_camera_sees_the_same_at_scaled_places() -> None:
    camera = camera_of("opencv", (-0.3, 0.1, 0.001, -0.002))
    half = camera.resized(640, 360)
    points = np.random.default_rng(0).uniform([5, -3, -1], [40, 3, 2], (50, 3))
    np.testing.assert_allclose((camera.project(points) + 0.5) / 2 - 0.5, half.project(points))
    plain = CameraParameters()
    assert plain.resized(560, 420) == replace(plain, width=560, height=420)
    wide = plain.resized(560, 210)
    assert wide.matrix == pytest.approx((2 * plain.focal_px, plain.focal_px, 279.5, 104.5))


def test_the_homography_is_the_projection_of_both_cameras() -> None:
    one = replace(camera_of("none", ()), pitch_deg=-2.0, roll_deg=-3.0)
    other = replace(CameraParameters(), x=one.x, y=one.y, z=one.z)
    points = np.random.default_rng(0).uniform([5, -1, -1], [40, 1, 2], (50, 3))
    pixels = np.column_stack([one.project(points), np.ones(50)]) @ one.homography(other).T
    np.testing.assert_allclose(pixels[:, :2] / pixels[:, 2:], other.project(points))


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"matrix": (0.0, 700.0, 640.0, 360.0)}, "singular"),
        ({"matrix": (700.0, 700.0, 640.0)}, "3 numbers; give 4"),
        ({"matrix": (700.0, 700.0, float("nan"), 360.0)}, "holds nan"),
        ({"distortion": "fisheye", "coefficients": (0.1,)}, "1 numbers; give 4"),
        ({"distortion": "opencv", "coefficients": (0.1,) * 6}, "give 4 or 5 or 8"),
        ({"coefficients": (0.1,) * 5}, "none distortion"),
        ({"distortion": "equirectangular"}, "give one of none, opencv, fisheye"),
        ({"height_std": -0.1}, "height_std"),
    ],
)
def test_impossible_lenses_are_refused(values: dict[str, object], message: str) -> None:
    with pytest.raises(CameraError, match=message) as caught:
        CameraParameters(1280, 720, **values)  # type: ignore[arg-type]
    assert isinstance(caught.value, UserError)
