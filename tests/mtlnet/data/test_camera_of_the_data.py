"""Cameras that a network is trained on. A model is trained further and evaluated only on data of
its own camera."""

from dataclasses import replace
from pathlib import Path
from unittest.mock import Mock

import pytest

from mtlnet.data.rounds import open_training_dataset, require_camera
from mtlnet.inference.model_card import ModelError
from tests.mtlnet.conftest import write_dataset
from trackfeatures.camera import CameraParameters
from trackfeatures.errors import UserError

PLAIN = CameraParameters()
TURNED = replace(PLAIN, yaw_deg=3.0)
LENS = replace(PLAIN, distortion="fisheye", coefficients=(0.1, 0.0, 0.0, 0.0))


@pytest.mark.parametrize(
    ("data", "model", "seen"),
    [
        (replace(PLAIN, fov_y_deg=50.0), PLAIN, "fov_y_deg 50 instead of 67.5"),
        (TURNED, PLAIN, "yaw_deg 3 instead of 0"),
        (PLAIN, TURNED, "yaw_deg 0 instead of 3"),
        (LENS, PLAIN, "distortion fisheye instead of none, coefficients (0.1, 0.0, 0.0, 0.0) inst"),
        (PLAIN, replace(PLAIN, width=320), "width 280 instead of 320"),
    ],
)
def test_the_differing_values_of_the_camera_are_named(
    data: CameraParameters, model: CameraParameters, seen: str
) -> None:
    card = Mock(camera=model)
    card.name = "default"
    with pytest.raises(ModelError) as raised:
        require_camera(card, data)
    assert f"is not that of model default: {seen}" in str(raised.value)
    require_camera(card, model)


def test_a_camera_beside_the_middle_of_the_car_is_not_trained_on(tmp_path: Path) -> None:
    """Training mirrors images, which moves such a camera to the other side."""
    data = write_dataset(tmp_path, camera=replace(PLAIN, y=-0.3))
    with pytest.raises(UserError, match=r"a camera -0\.3 m beside the middle of the car"):
        open_training_dataset(data)
