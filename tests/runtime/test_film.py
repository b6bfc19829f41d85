"""Films are read again by OpenCV."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from runtime.film import Mp4Writer


@pytest.mark.parametrize("fps", [0.5, 23.976, 66.12345, 239.8712, 999.1234])
def test_a_film_has_any_frame_rate(tmp_path: Path, fps: float) -> None:
    with Mp4Writer(tmp_path / "film.mp4", fps) as film:
        for _ in range(3):
            film.write(np.zeros((210, 280, 3), np.uint8))
    read = cv2.VideoCapture(str(tmp_path / "film.mp4"))
    assert read.get(cv2.CAP_PROP_FPS) == pytest.approx(fps, rel=1e-4)
    assert read.get(cv2.CAP_PROP_FRAME_COUNT) == 3
