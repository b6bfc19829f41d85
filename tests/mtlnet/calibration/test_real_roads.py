"""The pitch of one real drive, from pictures in a row: judged, never tuned on."""

import csv
import math
from pathlib import Path

import numpy as np
import pytest

from mtlnet.calibration.drive import calibrate_pictures
from mtlnet.calibration.lens import find_lens
from trackfeatures.camera import CameraParameters

FOLDER = Path(__file__).parents[4] / "shared" / "real_roads"


@pytest.mark.skipif(not FOLDER.is_dir(), reason="needs ../shared/real_roads")
def test_the_pitch_is_that_of_the_labels_horizon() -> None:
    with (FOLDER / "labels.csv").open() as file:
        rows = [row for row in csv.DictReader(file) if row["file"].startswith("udacity_project_")]
    fov_y_deg = float(rows[0]["fov_y_deg"])
    found = calibrate_pictures(
        [FOLDER / row["file"] for row in rows],
        lambda size: find_lens(size, CameraParameters(), fov_y_deg=fov_y_deg),
    ).found
    middle = (found.camera.height - 1) / 2
    labelled = [
        math.degrees(math.atan((middle - float(row["horizon_y_px"])) / float(row["focal_px"])))
        for row in rows
    ]
    assert found.camera.pitch_deg == pytest.approx(np.mean(labelled), abs=0.5)
