"""Images of other cameras: pixels against a projection, and answers in metres of a flat road."""

from dataclasses import replace
from unittest.mock import patch

import numpy as np
import pytest
from numpy.typing import NDArray

import trackfeatures as tf
from mtlnet.inference.image_decoding.errors import ImageError
from mtlnet.inference.prediction import decode_outputs, split_outputs
from mtlnet.inference.rectification import BORDER_LEVEL, Rectification
from trackfeatures.camera import CameraParameters

MODEL = CameraParameters()


def test_what_an_image_does_not_show_is_grey() -> None:
    narrow = replace(MODEL, fov_y_deg=45.0)
    found = Rectification(narrow, MODEL).image(np.full((420, 560, 3), 200, np.uint8))
    shown = np.tan(np.radians(22.5)) / np.tan(np.radians(33.75))
    assert (found == 200).all(2).mean() == pytest.approx(shown**2, abs=0.02)
    assert (found[:30] == BORDER_LEVEL).all()


def test_an_image_of_the_models_own_camera_stays_as_it_is() -> None:
    image = lane_picture(MODEL, (-1.6, 2.1), 0.06)
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


LENSES: dict[str, tuple[str, tuple[float, ...]]] = {
    "barrel": ("opencv", (-0.3, 0.1, 0.001, -0.0005)),
    "fisheye": ("fisheye", (-0.02, 0.004, -0.001, 0.0)),
    "pinhole": ("none", ()),
}


def mounted(lens: str) -> CameraParameters:
    """A camera off the middle, turned about all axes, principal point and pixels off square."""
    return CameraParameters(
        960, 600, matrix=(520.0, 500.0, 500.0, 280.0), x=1.4, y=0.3, z=1.15, pitch_deg=3.0,
        roll_deg=-4.0, yaw_deg=8.0, distortion=LENSES[lens][0], coefficients=LENSES[lens][1],
    )  # fmt: skip


def lane_picture(
    camera: CameraParameters, markings: tuple[float, float], angle: float
) -> NDArray[np.uint8]:
    """A picture of two markings 0.2 m wide, m to the right of a car that points `angle` rad to the
    right of a straight flat road."""
    columns, rows = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    ahead, left = camera.road_points(np.column_stack([columns.ravel(), rows.ravel()])).T
    right = ahead * np.sin(angle) - left * np.cos(angle)  # of the car, across the road
    near = np.min([np.abs(right - each) for each in markings], axis=0) < 0.1
    picture = np.where(near & (ahead < 40), 250, 20).astype(np.uint8)
    return np.repeat(picture.reshape(camera.height, camera.width, 1), 3, 2)


def answered_lane(picture: NDArray[np.uint8]) -> tuple[list[float], float]:
    """Distances and angle as a model answers them that takes every picture for one of its own."""
    weight = np.clip(picture[..., 0].astype(float) - 130.0, 0.0, None)
    weight[MODEL.height // 2 + 60 :] = 0.0
    rows, columns = np.nonzero(weight > 60)
    ahead, left = MODEL.road_points(np.column_stack([columns, rows])).T
    chosen = ahead < 12
    lines = []
    for side in (left > 0, left < 0):
        slope, offset = np.polyfit(ahead[chosen & side], left[chosen & side], 1)
        lines.append((-offset / np.hypot(1, slope), np.arctan(slope)))
    return [lines[0][0], lines[1][0]], float(np.mean([angle for _, angle in lines]))


@pytest.mark.parametrize("lens", LENSES)
@pytest.mark.parametrize("angle", [0.0, 0.06])
def test_a_turned_camera_gives_distances_and_angle_of_the_car(lens: str, angle: float) -> None:
    """The picture is of a camera 8 degrees to the left; the answer is the car's all the same."""
    camera = mounted(lens)
    picture = Rectification(camera, MODEL).image(lane_picture(camera, (-1.6, 2.1), angle))
    distances, found = answered_lane(picture)
    assert found == pytest.approx(angle, abs=0.003)
    answer = Rectification(camera, MODEL).outputs(outputs([*distances, *[np.nan] * 3], found))
    np.testing.assert_allclose(tf.decode(answer[:, :6])[0][0, :2], [-1.6, 2.1], atol=0.02)


@pytest.mark.parametrize("lens", LENSES)
@pytest.mark.parametrize("size", [(960, 600), (480, 300)])
def test_a_spot_is_where_the_rectified_view_sees_it(lens: str, size: tuple[int, int]) -> None:
    camera = mounted(lens)
    lens_of_size = camera.resized(*size)
    rectification = Rectification(camera, MODEL)
    columns, rows = np.meshgrid(np.arange(size[0]), np.arange(size[1]))
    for place in ((9.0, 1.5, -0.25), (14.0, -2.0, 0.5), (25.0, 0.0, -0.25)):
        u, v = lens_of_size.project([place])[0]
        image = np.full((size[1], size[0], 3), 10, np.uint8)
        image[(columns - u) ** 2 + (rows - v) ** 2 < (0.012 * size[0]) ** 2] = 250
        weight = rectification.image(image)[..., 0].astype(float)
        weight[(weight < 40) | (weight == BORDER_LEVEL)] = 0
        weight[np.abs(weight - BORDER_LEVEL) < 30] = 0
        found_rows, found_columns = np.indices(weight.shape)
        expected = rectification.view.project([place])[0]
        near = np.hypot(found_columns - expected[0], found_rows - expected[1]) < 12
        weight *= near
        assert weight.sum() > 200
        centre = [(weight * found_columns).sum(), (weight * found_rows).sum()] / weight.sum()
        np.testing.assert_allclose(centre, expected, atol=0.5)


def test_the_heights_uncertainty_widens_distances() -> None:
    """A height 5 % off puts a marking 2 m beside the camera 0.1 m off."""
    other = CameraParameters(x=0.0, y=0.5, z=1.25, height_std=0.05)
    target = replace(MODEL, x=0.0)
    answered = outputs([-2.0 / 1.25, 1.0 / 1.25, np.nan, np.nan, np.nan], 0.0)
    std = split_outputs(Rectification(other, target).outputs(answered)).std
    assert std is not None
    own = 0.125
    beside = np.array([2.0, 1.0, 0.0, 0.0, 0.0, 0.5])  # m; the last: lane centre
    np.testing.assert_allclose(std[0, :6], np.hypot(own, 0.05 * beside), rtol=1e-5)
    assert std[0, 6] == pytest.approx(0.01)


@pytest.mark.parametrize(
    ("height_m", "outside"), [(0.97, True), (1.0, False), (1.22, False), (1.56, False), (1.6, True)]
)
def test_a_camera_too_high_or_too_low_is_out_of_distribution(
    height_m: float, outside: bool
) -> None:
    """A lane of 3.6 m must look 2.75 to 4.4 m wide from 1.2 m: from 0.98 to 1.57 m it does."""
    other = CameraParameters(z=height_m - CameraParameters.cg_height_m)
    answered = Rectification(other, MODEL).outputs(
        outputs([-1.8, 1.8, np.nan, np.nan, np.nan], 0.0)
    )
    assert decode_outputs(answered[0]).out_of_distribution is outside


def test_labels_for_the_model_are_the_answers_turned_round() -> None:
    lens = Rectification(mounted("barrel"), MODEL)
    distances = np.array([[-1.7, 1.9, np.nan, np.nan, np.nan]], np.float32)
    angle = np.array([0.07], np.float32)
    wanted = lens.labels(distances, angle)
    assert np.isnan(wanted[0, 2:]).all()
    back = lens.outputs(outputs(wanted[0].tolist(), 0.07))
    np.testing.assert_allclose(tf.decode(back[:, :6])[0][0, :2], [-1.7, 1.9], atol=1e-5)


@pytest.mark.parametrize(
    ("shown", "hidden"),
    [
        (replace(MODEL, fov_y_deg=19.2), replace(MODEL, fov_y_deg=17.0)),
        (replace(MODEL, yaw_deg=20.0), replace(MODEL, yaw_deg=75.0)),
    ],
)
def test_a_quarter_of_rows_or_columns_is_answered_less_is_refused(
    shown: CameraParameters, hidden: CameraParameters
) -> None:
    """tan(9.6 deg) is a quarter of tan(33.75 deg)."""
    image = np.zeros((420, 560, 3), np.uint8)
    assert Rectification(shown, MODEL).image(image).shape[0] == 210
    with pytest.raises(ImageError, match=r"shows \d+% of the (rows|columns) of .* at least 25%"):
        Rectification(hidden, MODEL).image(image)


def test_an_image_without_road_or_of_another_shape_is_refused() -> None:
    upwards = Rectification(replace(MODEL, fov_y_deg=30.0, pitch_deg=-14.0), MODEL)
    with pytest.raises(ImageError, match=r"rows below the horizon .*looks along the road"):
        upwards.image(np.zeros((210, 280, 3), np.uint8))
    with pytest.raises(ImageError, match="560 x 400 px, its camera gives 280 x 210"):
        Rectification(MODEL, MODEL).image(np.zeros((400, 560, 3), np.uint8))


@pytest.mark.parametrize("kind", ["none", "opencv"])
@pytest.mark.parametrize(("yaw_deg", "pitch_deg"), [(75.0, 0.0), (-80.0, 0.0), (0.0, 80.0)])
def test_what_is_behind_the_camera_is_grey(yaw_deg: float, pitch_deg: float, kind: str) -> None:
    """A pixel of the view has the grey of the border exactly where its direction is not seen."""
    wide = replace(MODEL, fov_y_deg=120.0, yaw_deg=yaw_deg, pitch_deg=pitch_deg)
    source = replace(wide, distortion=kind, coefficients=(0.0,) * 4 if kind == "opencv" else ())
    lens = Rectification(source, MODEL)
    with patch.object(Rectification, "check"):  # it would refuse the picture: it shows too little
        found = lens.image(np.full((420, 560, 3), 200, np.uint8))
    columns, rows = np.meshgrid(np.arange(MODEL.width), np.arange(MODEL.height))
    rays = MODEL.rays(np.column_stack([columns.ravel(), rows.ravel()])) @ MODEL.rotation()
    is_ahead = (rays @ wide.rotation().T)[:, 2].reshape(rows.shape) > 0
    assert (found[~is_ahead] == BORDER_LEVEL).all()
    assert 0.05 < (~is_ahead).mean() < 0.9
