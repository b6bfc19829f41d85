"""Averaging over views: the geometry of the views, the rules of the mean, the symmetry."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

import trackfeatures as tf
from mtlnet import load
from mtlnet.inference.engine import load_engine
from mtlnet.inference.model_card import resolve_run
from mtlnet.inference.prediction import FEATURES, decode_outputs, split_outputs
from mtlnet.inference.view_average import TURN_RAD, Views, mean_outputs, mirror_outputs
from tests.mtlnet.conftest import draw_road
from trackfeatures.camera import CameraParameters
from trackfeatures.errors import UserError

CAMERA = CameraParameters()


def outputs_of(
    distances: dict[str, float], angle: float = 0.0, absent: float = 0.0, left: float = 0.2
) -> NDArray[np.float32]:
    """Outputs (1, 22) of one image: distances (m) of the markings that are present, angle (rad),
    probability of absence of each marking, probability of the class left."""
    values = [distances.get(name, np.nan) for name in tf.MARKINGS]
    coded = tf.encode([values], [angle])[0]
    std = [0.1 * (i + 1) for i in range(len(FEATURES))]
    rest = [left, 0.7, 0.3 - left, *std, 0.5, *[absent] * 5]
    return np.array([[*coded, *rest]], np.float32)


def test_the_mirrored_scene_has_its_sides_swapped() -> None:
    outputs = outputs_of({"ml": -1.5, "mr": 2.5}, angle=0.1, left=0.2)
    mirrored = mirror_outputs(outputs)
    found = decode_outputs(mirrored[0])
    assert found.distances_m["ml"] == pytest.approx(-2.5, abs=1e-5)
    assert found.distances_m["mr"] == pytest.approx(1.5, abs=1e-5)
    assert found.angle_rad == pytest.approx(-0.1, abs=1e-6)
    assert found.heading == pytest.approx({"left": 0.1, "straight": 0.7, "right": 0.2})
    std = split_outputs(mirrored).std
    assert std is not None
    assert std[0] == pytest.approx([0.2, 0.1, 0.5, 0.4, 0.3, 0.6, 0.7])  # ml and mr, l and r
    np.testing.assert_allclose(mirror_outputs(mirrored), outputs, atol=1e-6)


def test_values_are_averaged_over_the_views_that_contain_the_marking() -> None:
    first = outputs_of({"ml": -1.0, "mr": 3.0}, angle=0.02, absent=0.1)
    second = outputs_of({"ml": -1.4, "mr": 2.8}, angle=0.04, absent=0.3)
    mean = mean_outputs(np.stack([first, mirror_outputs(second)]))
    found = decode_outputs(mean[0])
    assert found.distances_m["ml"] == pytest.approx(-1.2, abs=1e-5)
    assert found.distances_m["mr"] == pytest.approx(2.9, abs=1e-5)
    assert found.angle_rad == pytest.approx(0.03, abs=1e-6)
    assert found.absent == pytest.approx(dict.fromkeys(tf.MARKINGS, 0.2))
    assert found.std is not None
    assert found.std["ml"] == pytest.approx(0.84 * 0.1)
    assert found.std["angle"] == pytest.approx(0.84 * 0.7)
    without = outputs_of({}, absent=0.3)
    found = decode_outputs(mean_outputs(np.stack([first, mirror_outputs(without)]))[0])
    assert found.distances_m["ml"] == pytest.approx(-1.0, abs=1e-5)


def test_a_marking_is_absent_if_the_mean_probability_exceeds_the_limit() -> None:
    first, second = outputs_of({"ml": -1.0, "mr": 3.0}, absent=0.4), outputs_of({}, absent=0.9)
    mean = decode_outputs(mean_outputs(np.stack([first, mirror_outputs(second)]))[0])
    assert mean.distances_m["ml"] is None
    assert mean.absent == pytest.approx(dict.fromkeys(tf.MARKINGS, 0.65))


def test_a_model_without_probabilities_of_absence_keeps_the_first_view_s_decision() -> None:
    first, second = outputs_of({"ml": -1.0, "mr": 3.0})[:, :9], outputs_of({})[:, :9]
    for one, other, expected in ((first, second, -1.0), (second, first, None)):
        mean = decode_outputs(mean_outputs(np.stack([one, mirror_outputs(other)]))[0])
        assert mean.distances_m["ml"] == pytest.approx(expected, abs=1e-5)


def test_turned_views_are_those_of_a_turned_camera() -> None:
    camera = CameraParameters(pitch_deg=3.0)
    place = (60.0, 4.0, 0.5)
    image = np.zeros((210, 280, 3), np.uint8)
    u, v = camera.project([place])[0]
    image[round(v) - 1 : round(v) + 2, round(u) - 1 : round(u) + 2] = 255
    plain, mirrored, *turned = Views(6, camera).of(image)
    assert plain is image
    assert np.array_equal(mirrored, image[:, ::-1])
    assert np.array_equal(turned[1], turned[0][:, ::-1])
    assert np.array_equal(turned[3], turned[2][:, ::-1])
    columns = []
    for view in turned[::2]:
        rows, cols = np.nonzero(view[..., 0] > 100)
        columns.append(cols.mean())
        assert rows.mean() == pytest.approx(v, abs=1.0)
    expected = []
    for yaw in (TURN_RAD, -TURN_RAD):
        seen = replace(camera, yaw_deg=camera.yaw_deg + np.degrees(yaw))
        expected.append(seen.project([place])[0][0])
    assert sorted(columns) == pytest.approx(sorted(expected), abs=0.7)
    turn_px = 2 * TURN_RAD * camera.focal_px
    assert max(columns) - min(columns) == pytest.approx(turn_px, abs=1.5)


@pytest.mark.parametrize("count", [2, 6])
def test_the_mean_answers_a_mirrored_image_with_the_mirrored_features(count: int) -> None:
    engine = load_engine(resolve_run("default"), precision="f32", views=count)
    image = draw_road(0.7, 0.04)
    outputs = engine(image)[None]
    mirrored = engine(np.ascontiguousarray(image[:, ::-1]))[None]
    # The mean of distances is computed after decoding, hence a tolerance of float32.
    np.testing.assert_allclose(mirror_outputs(mirrored), outputs, rtol=2e-3, atol=2e-3)
    single = load_engine(resolve_run("default"), precision="f32")
    assert not np.allclose(single(image), outputs[0], atol=1e-4)
    assert decode_outputs(outputs[0]).to_lane_centre_m == pytest.approx(0.7, abs=0.15)


def test_torch_computes_the_same_mean(published: Path) -> None:
    image = draw_road(-0.5, 0.02)
    torch = load_engine(published, "torch", views=6)
    openvino = load_engine(published, precision="f32", views=6)
    np.testing.assert_allclose(openvino(image)[:9], torch(image)[:9], atol=2e-5)
    batch = torch.batch(np.stack([image, image]))  # type: ignore[attr-defined]
    assert batch[1].tolist() == pytest.approx(torch(image).tolist(), abs=1e-5)


def test_another_number_of_views_is_refused() -> None:
    with pytest.raises(UserError, match="--views 3: give 1, 2 or 6"):
        load("default", views=3)


def test_a_camera_beside_the_middle_of_the_car_has_one_view() -> None:
    beside = CameraParameters(y=0.4)
    Views(1, beside)
    for count in (2, 6):
        with pytest.raises(UserError, match=rf"--views {count}: the model's camera is 0\.4 m besi"):
            Views(count, beside)
