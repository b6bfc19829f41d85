"""Camera parameters: pinhole matrix, height above the road, refused values, stored form."""

import json
from typing import Any

import numpy as np
import pytest

from trackfeatures import UserError
from trackfeatures.camera import CameraParameters


def test_intrinsics_of_a_lens_of_90_degrees() -> None:
    """tan(45 deg) = 1, so the focal length is half of the image height."""
    camera = CameraParameters(width=280, height=210, fov_y_deg=90.0)
    assert camera.focal_px == pytest.approx(105.0)
    expected = [[105.0, 0.0, 139.5], [0.0, 105.0, 104.5], [0.0, 0.0, 1.0]]
    assert np.allclose(camera.intrinsics(), expected)


def test_the_default_camera_is_1_20_m_above_the_road() -> None:
    assert CameraParameters().height_above_road_m == pytest.approx(1.20)


@pytest.mark.parametrize(
    "values",
    [
        *({name: value} for name in ("width", "height") for value in (-5, 280.5, "280")),
        *({name: float("nan")} for name in ("x", "y", "z", "pitch_deg", "roll_deg", "yaw_deg")),
        *({"z": value} for value in (float("inf"), "a", None)),
        {"fov_y_deg": "a"},
    ],
)
def test_sizes_and_mounts_that_are_no_numbers_are_refused(values: dict[str, Any]) -> None:
    (name,) = values
    with pytest.raises(UserError, match="vertical field of view" if name == "fov_y_deg" else name):
        CameraParameters(**values)


@pytest.mark.parametrize("fov_y_deg", [0.0, -20.0, 180.0, float("nan")])
def test_an_impossible_field_of_view_is_refused(fov_y_deg: float) -> None:
    """The error is a UserError for commands and a ValueError for readers of damaged files."""
    with pytest.raises(UserError, match="between 1 and 150 deg") as caught:
        CameraParameters(fov_y_deg=fov_y_deg)
    assert isinstance(caught.value, ValueError)


def test_the_stored_form_has_the_names_of_recordings_and_model_cards() -> None:
    stored = CameraParameters(pitch_deg=3.0).as_dict()
    assert list(stored) == ["width", "height", "fov_y_deg", "x", "y", "z", "pitch_deg"]
    assert CameraParameters(**stored) == CameraParameters(pitch_deg=3.0)


def test_new_fields_are_stored_where_they_are_not_the_default() -> None:
    camera = CameraParameters(
        1280, 720, matrix=(700, 700, 640, 360), distortion="fisheye", coefficients=(0.1, 0, 0, 0)
    )
    stored = camera.as_dict()
    assert list(stored)[7:] == ["matrix", "distortion", "coefficients"]
    assert CameraParameters(**json.loads(json.dumps(stored))) == camera
    assert hash(CameraParameters(**json.loads(json.dumps(stored)))) == hash(camera)
    assert camera.fov_y_deg == pytest.approx(np.degrees(2 * np.arctan(360 / 700)))
