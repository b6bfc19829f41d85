"""Targets of a network for a round whose camera is higher or lower than the model's."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import trackfeatures as tf
from datagen.recording import Dataset, Frames
from mtlnet.data.loader import Loader
from mtlnet.data.model_labels import camera_scales, car_outputs, model_labels
from mtlnet.data.road_ahead import lane_beside
from mtlnet.inference.prediction import COLUMNS, split_outputs
from tests.mtlnet.conftest import HIGH_ROUNDS, write_dataset
from trackfeatures.camera import CameraParameters

MODEL = CameraParameters()  # 1.2 m above the road


def dataset(folder: Path, **changes: Any) -> Frames:
    folder.mkdir()
    return Dataset.open(write_dataset(folder, **changes)).select("all")


@pytest.fixture
def high(tmp_path: Path) -> Frames:
    """Rounds with lanes of 4.0 m and a camera 1.8 m above the road, for which a lane looks two
    thirds as wide."""
    return dataset(tmp_path / "high", **HIGH_ROUNDS)


def test_labels_are_those_of_a_road_two_thirds_as_wide(high: Frames) -> None:
    scale = 1.2 / 1.8
    labels, found = high.labels, model_labels(high)
    assert high.camera == MODEL
    assert camera_scales(high) == pytest.approx(np.full(len(high), scale))
    shift = (1 - scale) * MODEL.x * np.sin(labels.angle)
    both = ~np.isnan(labels.distances) & ~np.isnan(found.distances)
    assert both.sum() > len(high)
    expected = labels.distances * scale + shift[:, None]
    assert found.distances[both] == pytest.approx(expected[both], abs=1e-5)
    # Presence follows from the picture: at least 0.5 m of the model's metres from both markings.
    for row, place in enumerate((labels.to_middle * scale + shift).tolist()):
        there = tf.measure(place, 0.0, 0.0, 0.0, 1, 4.0 * scale).distances.values()
        assert [d is None for d in there] == np.isnan(found.distances[row]).tolist()
    assert found.angle == pytest.approx(labels.angle)


def test_training_and_answering_are_inverse(high: Frames) -> None:
    """A network that answers exactly its training targets is right in metres of the car."""
    loader = Loader(high, MODEL, 4, 0, augment=False)
    classes = np.eye(3, dtype=np.float32)[high.labels.heading]
    outputs = car_outputs(np.concatenate([loader.coded, classes], 1), high)
    distances, angle = tf.decode(outputs[:, :6])
    truth = high.labels.distances
    both = ~np.isnan(distances) & ~np.isnan(truth)
    assert both.sum() > len(high)
    # Coded values are float32: 1e-7 of a range of 5.5 m.
    assert distances[both] == pytest.approx(truth[both], abs=2e-5)
    assert angle == pytest.approx(high.labels.angle, abs=1e-6)


def test_a_recorded_rounds_height_is_no_reason_for_doubt(high: Frames) -> None:
    """A camera file with this height, 1.8 m, would make a lane of 3.6 m look 2.4 m wide."""
    outputs = np.full((len(high), 9 + COLUMNS), 0.5, np.float32)
    score = split_outputs(car_outputs(outputs, high)).ood_score
    assert score is not None
    assert score == pytest.approx(np.full(len(high), 0.5))


def test_the_lane_beside_is_as_wide_as_it_looks(high: Frames) -> None:
    left, right = lane_beside(high).T
    assert right - left == pytest.approx(np.full(len(high), 4.0 * 1.2 / 1.8))


def test_jittered_rounds_and_those_of_before_keep_their_labels(tmp_path: Path) -> None:
    jittered = CameraParameters(z=1.0, pitch_deg=1.0)
    for frames in (
        dataset(tmp_path / "jittered", camera=jittered, nominal_camera=MODEL),
        dataset(tmp_path / "before"),
    ):
        found = model_labels(frames)
        assert np.array_equal(found.distances, frames.labels.distances, equal_nan=True)
        outputs = np.zeros((len(frames), 9), np.float32)
        assert np.array_equal(car_outputs(outputs, frames), outputs)
