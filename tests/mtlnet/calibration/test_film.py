"""Mounts estimated from drawn drives: straight roads by closed-form projection, with a car that
sways."""

import math
from dataclasses import replace

import numpy as np
import pytest

from mtlnet.calibration.film import DriveCalibration, DriveEstimate
from mtlnet.calibration.lens import KnownLens
from mtlnet.calibration.mount import NotCalibrated
from tests.mtlnet.calibration.drawn import road_picture
from trackfeatures.camera import CameraParameters

LENS = CameraParameters(480, 270, fov_y_deg=55.0, x=0.7)
SPEED = 18.0
LANE_M = 3.5
MOUNTS = [
    replace(LENS, z=1.1, pitch_deg=3.0, yaw_deg=-2.5, roll_deg=1.5),
    replace(LENS, z=0.9, pitch_deg=-4.0, yaw_deg=3.0, roll_deg=-1.0),
]


def calibrated(
    camera: CameraParameters, pictures: int = 40, lane_m: float | None = LANE_M
) -> DriveEstimate:
    """The estimate from a car that sways 0.4 m to both sides of the middle of its lane."""
    calibration = DriveCalibration(KnownLens(LENS, 0.0, "given"), lane_m)
    for number in range(pictures):
        time_s = 0.2 * number
        left = 0.4 * math.sin(time_s)
        heading = math.atan(0.4 * math.cos(time_s) / SPEED)
        markings = [side * LANE_M - left for side in (-1.5, -0.5, 0.5)]
        calibration.add(road_picture(camera, markings, heading), time_s)
    return calibration.estimate()


@pytest.mark.parametrize("camera", MOUNTS)
def test_a_drawn_drive_gives_the_mount_back(camera: CameraParameters) -> None:
    found = calibrated(camera)
    assert found.camera.pitch_deg == pytest.approx(camera.pitch_deg, abs=0.08)
    assert found.camera.yaw_deg == pytest.approx(camera.yaw_deg, abs=0.08)
    assert found.camera.roll_deg == pytest.approx(camera.roll_deg, abs=0.3)
    height = camera.height_above_road_m
    assert found.camera.height_above_road_m == pytest.approx(height, rel=0.01)
    assert found.pitch_std_deg < 0.2
    assert found.yaw_std_deg < 0.2
    assert found.camera.height_std < 0.02
    assert found.pictures >= 30
    # Values that are not estimated stay unchanged.
    assert (found.camera.x, found.camera.y) == (LENS.x, LENS.y)
    assert found.camera.intrinsics() == pytest.approx(LENS.intrinsics())


def test_an_assumed_lane_width_is_uncertain() -> None:
    found = calibrated(MOUNTS[0], pictures=20, lane_m=None)
    height = MOUNTS[0].height_above_road_m * 3.6 / LANE_M
    assert found.camera.height_above_road_m == pytest.approx(height, rel=0.01)
    assert found.camera.height_std == pytest.approx(0.25 / 3.6, rel=0.05)
    assert "lane width 3.6 m, assumed" in found.about()


def test_the_field_of_view_does_not_change_the_height() -> None:
    wrong = KnownLens(replace(LENS, fov_y_deg=45.0), 0.2, "guessed")
    right = DriveCalibration(KnownLens(LENS, 0.0, "given"), LANE_M)
    other = DriveCalibration(wrong, LANE_M)
    for number in range(20):
        picture = road_picture(replace(LENS, pitch_deg=2.0), [-1.75, 1.75])
        for calibration in (right, other):
            calibration.add(picture, 0.2 * number)
    found, scaled = right.estimate(), other.estimate()
    assert scaled.camera.height_above_road_m == pytest.approx(
        found.camera.height_above_road_m, rel=0.01
    )
    ratio = LENS.focal_px / replace(LENS, fov_y_deg=45.0).focal_px
    assert math.tan(math.radians(scaled.camera.pitch_deg)) == pytest.approx(
        ratio * math.tan(math.radians(found.camera.pitch_deg)), rel=0.05
    )
    assert scaled.pitch_std_deg >= 0.2 * scaled.camera.pitch_deg


def test_a_distorted_lens_gives_the_same_mount() -> None:
    bent = replace(MOUNTS[0], distortion="opencv", coefficients=(-0.2, 0.03, 0.0, 0.0))
    calibration = DriveCalibration(
        KnownLens(replace(LENS, distortion="opencv", coefficients=bent.coefficients), 0.0, ""),
        LANE_M,
    )
    for number in range(20):
        calibration.add(road_picture(bent, [-5.25, -1.75, 1.75]), 0.2 * number)
    found = calibration.estimate().camera
    assert found.pitch_deg == pytest.approx(bent.pitch_deg, abs=0.1)
    assert found.yaw_deg == pytest.approx(bent.yaw_deg, abs=0.1)
    assert found.height_above_road_m == pytest.approx(bent.height_above_road_m, rel=0.01)


def test_few_pictures_and_pictures_without_markings_are_refused() -> None:
    with pytest.raises(NotCalibrated, match=r"5 of 5 pictures show both markings.* at least 12"):
        calibrated(MOUNTS[0], pictures=5)
    calibration = DriveCalibration(KnownLens(LENS, 0.0, ""))
    with pytest.raises(NotCalibrated, match="no markings of a road can be seen in 0 pictures"):
        calibration.estimate()
    rng = np.random.default_rng(0)
    for number in range(30):
        noise = rng.normal(110, 6, (270, 480, 3)).clip(0, 255).astype(np.uint8)
        calibration.add(noise, 0.2 * number)
    with pytest.raises(NotCalibrated, match=r"in 30 pictures|of 30 pictures show"):
        calibration.estimate()


def test_pictures_in_between_are_passed_over() -> None:
    calibration = DriveCalibration(KnownLens(LENS, 0.0, ""))
    picture = road_picture(LENS, [-1.75, 1.75])
    for number in range(61):
        calibration.add(picture, number / 30)
    assert calibration.pictures == 11
