"""Images of other cameras: pixels against a projection, and answers in metres of a flat road."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

import trackfeatures as tf
from mtlnet.inference.image_decoding.errors import ImageError
from mtlnet.inference.prediction import split_outputs
from mtlnet.inference.rectification import BORDER_LEVEL, Rectification, read_camera
from trackfeatures.camera import CameraParameters
from trackfeatures.errors import UserError

MODEL = CameraParameters()
OTHER = CameraParameters(width=640, height=360, fov_y_deg=40.0, x=1.2, z=1.25, pitch_deg=4.0)


def pixel(
    camera: CameraParameters, ahead: float, left: float, size: tuple[int, int]
) -> list[float]:
    """Where a point of a flat road, m from the camera, is in its image of that size: (u, v)."""
    focal, down = camera.focal_px * size[1] / camera.height, np.radians(camera.pitch_deg)
    depth = ahead * np.cos(down) + camera.height_above_road_m * np.sin(down)
    below = camera.height_above_road_m * np.cos(down) - ahead * np.sin(down)
    return [
        (size[0] - 1) / 2 - focal * left / depth,
        (size[1] - 1) / 2 + focal * below / depth,
    ]


def dots(camera: CameraParameters, size: tuple[int, int]) -> NDArray[np.uint8]:
    """An image of white spots on the road, 12 m ahead and 20 m, in its lane."""
    rows, columns = np.mgrid[: size[1], : size[0]]
    image = np.full((size[1], size[0], 3), 10, np.uint8)
    for ahead, left in ((12.0, 1.0), (20.0, -2.0)):
        u, v = pixel(camera, ahead, left, size)
        radius = 0.02 * size[0]
        image[(columns - u) ** 2 + (rows - v) ** 2 < radius**2] = 250
    return image


@pytest.mark.parametrize("size", [(640, 360), (1280, 720), (160, 90)])
def test_points_are_where_the_models_camera_sees_them(size: tuple[int, int]) -> None:
    found = Rectification(OTHER, MODEL).image(dots(OTHER, size))
    assert found.shape == (210, 280, 3)
    seen_from = replace(MODEL, z=OTHER.z)
    rows, columns = np.mgrid[:210, :280]
    for ahead, left in ((12.0, 1.0), (20.0, -2.0)):
        u, v = pixel(seen_from, ahead, left, (280, 210))
        near = (np.abs(columns - u) < 9) & (np.abs(rows - v) < 9)
        weight = np.where(near & (found[..., 0] > 40), found[..., 0].astype(float), 0.0)
        assert weight.sum() > 200
        assert (weight * columns).sum() / weight.sum() == pytest.approx(u, abs=0.5)
        assert (weight * rows).sum() / weight.sum() == pytest.approx(v, abs=0.5)


def test_what_an_image_does_not_show_is_grey() -> None:
    narrow = replace(MODEL, fov_y_deg=45.0)
    found = Rectification(narrow, MODEL).image(np.full((420, 560, 3), 200, np.uint8))
    shown = np.tan(np.radians(22.5)) / np.tan(np.radians(33.75))
    assert (found == 200).all(2).mean() == pytest.approx(shown**2, abs=0.02)
    assert (found[:30] == BORDER_LEVEL).all()


def test_an_image_of_the_models_own_camera_stays_as_it_is() -> None:
    image = dots(MODEL, (280, 210))
    np.testing.assert_array_equal(Rectification(MODEL, MODEL).image(image), image)


def outputs(distances: list[float], angle: float) -> NDArray[np.float32]:
    coded = tf.encode([distances], [angle])[0]
    return np.array([[*coded, 0.1, 0.8, 0.1, *[0.1] * 6, 0.01, 0.5, *[0.2] * 5]], np.float32)


def test_answers_are_metres_beside_the_car_of_the_other_camera() -> None:
    """A lane of 3.6 m seen by a camera 1.5 m above the road, the car 0.3 m beside the middle."""
    angle = 0.1
    other = CameraParameters(x=1.2, y=0.1, z=1.25, fov_y_deg=60.0)
    ratio = 1.5 / 1.2
    # The eye stands `aside` m beside the car's centre; the model takes all to be 1.2 m below it.
    aside = -1.2 * np.sin(angle) + 0.1 * np.cos(angle)
    beside_eye = np.array([-2.1, 1.5]) + aside
    for_model = beside_eye / ratio + 0.75 * np.sin(angle)
    answered = outputs([*for_model.tolist(), np.nan, np.nan, np.nan], angle)
    found = Rectification(other, MODEL).outputs(answered)
    distances, turned = tf.decode(found[:, :6])
    np.testing.assert_allclose(distances[0, :2], [-2.1, 1.5], atol=1e-5)
    assert np.isnan(distances[0, 2:]).all()
    assert turned[0] == pytest.approx(angle, abs=1e-6)
    std = split_outputs(found).std
    assert std is not None
    np.testing.assert_allclose(std[0], [0.1 * ratio] * 6 + [0.01], rtol=1e-5)
    np.testing.assert_array_equal(found[:, 6:9], answered[:, 6:9])
    assert split_outputs(answered).std is not None
    np.testing.assert_allclose(answered[0, 9], 0.1)  # unchanged


def test_an_image_that_shows_too_little_or_has_another_shape_is_refused() -> None:
    narrow = Rectification(replace(MODEL, fov_y_deg=20.0), MODEL)
    with pytest.raises(ImageError, match=r"does not show 3[67]% .* at the top, at most 30%"):
        narrow.image(np.zeros((420, 560, 3), np.uint8))
    upwards = Rectification(replace(MODEL, pitch_deg=-29.0), MODEL)
    with pytest.raises(ImageError, match=r"at the bottom, .*looks along the road"):
        upwards.image(np.zeros((210, 280, 3), np.uint8))
    with pytest.raises(ImageError, match="560 x 400 px, its camera gives 280 x 210"):
        Rectification(MODEL, MODEL).image(np.zeros((400, 560, 3), np.uint8))


def test_a_camera_is_read_from_yaml(tmp_path: Path) -> None:
    path = tmp_path / "camera.yaml"
    path.write_text("width: 640\nheight: 360\nfov_y_deg: 40\nheight_above_road_m: 1.5\n")
    found = read_camera(path, MODEL)
    assert found == replace(MODEL, width=640, height=360, fov_y_deg=40, z=1.25)
    assert found.height_above_road_m == 1.5


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "describes no camera"),
        ("- 3", "describes no camera"),
        ("fov_y_deg: [", "cannot be read as a camera"),
        ("fov: 60", "unknown key 'fov'; known are width"),
        ("fov_y_deg: wide", "fov_y_deg is 'wide'; give a number"),
        ("width: 640.5", "width is 640.5; give a whole number of pixels"),
        ("fov_y_deg: 170", "vertical field of view 170 deg"),
        ("z: 1.0\nheight_above_road_m: 1.2", "gives both z and height_above_road_m"),
        ("height_above_road_m: 0", "is impossible; give sizes above 0"),
        ("z: .nan", "is impossible"),
        ("x: .inf", "is impossible"),
        ("pitch_deg: 40", "pitch_deg is 40; give -30 to 30"),
    ],
)
def test_a_faulty_camera_file_is_one_clear_line(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "camera.yaml"
    path.write_text(text)
    with pytest.raises(UserError, match=message) as caught:
        read_camera(path, MODEL)
    assert "\n" not in str(caught.value)


def test_a_missing_camera_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"none.yaml cannot be read as a camera: No such file"):
        read_camera(tmp_path / "none.yaml", MODEL)
