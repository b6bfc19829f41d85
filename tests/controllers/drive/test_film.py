"""The film of a drive: size, length, curves, and a film of an interrupted drive."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from controllers.drive.config import DriveConfig
from controllers.drive.film import CURVE_HEIGHT, curves
from controllers.drive.run import drive
from mtlnet.inference.overlay import PREDICTION_COLOUR, TRUTH_COLOUR


def frames(path: Path) -> list[NDArray[np.uint8]]:
    film = cv2.VideoCapture(str(path))
    found: list[NDArray[np.uint8]] = []
    while True:
        more, picture = film.read()
        if not more:
            return found
        found.append(np.asarray(cv2.cvtColor(picture, cv2.COLOR_BGR2RGB), dtype=np.uint8))


def test_a_drive_on_the_truth_is_filmed(tmp_path: Path) -> None:
    path = tmp_path / "drive.mp4"
    drive(DriveConfig(steps=8, video=path, start_d=0.3))
    shown = frames(path)
    assert len(shown) == 8
    assert shown[0].shape == (2 * 210 + 28 + 2 * CURVE_HEIGHT, 2 * 280 + 160, 3)
    # The true markings are drawn over the painted markings, in both views.
    red, green, blue = np.moveaxis(shown[0][:420].astype(int), 2, 0)
    drawn = green - np.maximum(red, blue) > 80
    assert drawn[:, :560].sum() > 100
    assert drawn[:, 560:].sum() > 100


def test_an_interrupted_film_contains_the_driven_part(tmp_path: Path) -> None:
    path = tmp_path / "drive.mp4"

    def stop(done: int, total: int) -> None:
        if done == 4:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        drive(DriveConfig(steps=50, video=path), stop)
    assert len(frames(path)) == 5


def test_curves_rise_to_the_left_and_have_gaps_without_perception() -> None:
    values = np.array([[0.5, np.nan]] * 10 + [[-0.5, 0.9]] * 10)
    strip = curves(values, 20, 400, 1.0, "offset").astype(int)

    def rows(colour: tuple[int, int, int], columns: slice) -> NDArray[np.int64]:
        near = np.abs(strip - colour).sum(axis=2) < 60
        return np.flatnonzero(near[:, columns].any(axis=1))

    middle = CURVE_HEIGHT // 2
    assert rows(TRUTH_COLOUR, slice(0, 150)).max() < middle  # left: up
    assert rows(TRUTH_COLOUR, slice(250, 400)).min() > middle
    assert len(rows(PREDICTION_COLOUR, slice(0, 150))) == 0
    assert rows(PREDICTION_COLOUR, slice(250, 400)).max() < 12
