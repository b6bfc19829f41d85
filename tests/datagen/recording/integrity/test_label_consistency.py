"""Label consistency: correct labels pass, wrong ones are found."""

from dataclasses import replace

import numpy as np
import pytest

import trackfeatures as tf
from datagen.recording.integrity.label_consistency import label_problems
from datagen.recording.labels import Labels
from tests.datagen.recording.labels import labels_of

WIDTH = 4.0


def _labels(offsets: np.ndarray, lanes: int, width: float = WIDTH) -> Labels:
    """Labels as read from a recording: measured in float64, read as float32."""
    features = [tf.measure(y, 0.0, 0.0, 0.0, lanes, width) for y in offsets.tolist()]
    distances = np.array([[*f.distances.values()] for f in features], dtype=np.float64)
    centre = np.array([f.to_lane_centre for f in features], dtype=np.float64)
    return labels_of(
        len(offsets),
        distances=distances,
        lanes=np.full(len(offsets), lanes),
        lane_index=np.array([tf.lane_index(y, lanes, width) for y in offsets.tolist()]),
        to_lane_centre=centre.astype(np.float32),
        to_middle=offsets.astype(np.float32),
    )


@pytest.mark.parametrize("lanes", tf.LANES)
@pytest.mark.parametrize("width", [2.7, 3.7, 4.5])
def test_correct_labels_near_range_borders_have_no_problems(lanes: int, width: float) -> None:
    markings = tf.marking_offsets(lanes, width)
    reaches = [0.0, 0.5, 1.2, 2.0, width / 2]
    borders = np.array([m + side * r for m in markings for r in reaches for side in (-1, 1)])
    beside = np.concatenate([borders + d for d in (-1e-6, -1e-8, -1e-15, 0.0, 1e-15, 1e-8, 1e-6)])
    offsets = np.concatenate([beside, np.linspace(-9.0, 9.0, 181)])
    assert (
        list(label_problems(_labels(offsets, lanes, width), np.zeros(len(offsets)), lanes, width))
        == []
    )


@pytest.mark.parametrize(
    ("column", "value", "expected"),
    [
        ("ml", np.nan, "1 of 4 labels do not follow from the offset"),
        ("mr", 2.5, "1 of 4 labels do not follow from the offset"),
        ("m", 1.1, "1 of 4 labels do not follow from the offset"),
        ("lane_index", 0, "1 of 4 lane indices do not follow"),
        ("to_lane_centre", np.nan, "1 of 4 lane-centre offsets do not follow"),
        ("to_lane_centre", -0.29, "1 of 4 lane-centre offsets do not follow"),
        ("to_middle", np.nan, "1 of 4 labels do not follow from the offset"),
        ("lanes", 3, "1 of 4 labels do not have the 2 lanes of the round"),
    ],
)
def test_missing_invented_and_wrong_labels_are_found(
    column: str, value: float, expected: str
) -> None:
    """All cars stand 0.3 m right of the centre of the right lane of two: ml -2.3, mr 1.7."""
    labels = _labels(np.full(4, -2.3), lanes=2)
    name = "distances" if column in tf.MARKINGS else column
    changed = getattr(labels, name).copy()
    assert list(label_problems(labels, np.zeros(len(labels)), 2, WIDTH)) == []
    if name == "distances":
        changed[2, tf.MARKINGS.index(column)] = value
    else:
        changed[2] = value
    found = list(
        label_problems(replace(labels, **{name: changed}), np.zeros(len(labels)), 2, WIDTH)
    )
    assert any(expected in line for line in found), found


def test_an_impossible_road_is_found() -> None:
    labels = _labels(np.zeros(3), lanes=1)
    assert "an impossible road: a road of 7 lanes" in next(
        label_problems(labels, np.zeros(4), 7, WIDTH)
    )


def test_on_banked_road_distances_may_be_measured_from_the_foot_point() -> None:
    """0.25 m above a bank of 9 deg the foot is 0.04 m up the bank; on a level road right below."""
    offsets = np.linspace(-5.9, 5.9, 400)
    feet = _labels(offsets + 0.04, 2, WIDTH)
    labels = replace(
        feet, to_middle=offsets.astype(np.float32), lane_index=_labels(offsets, 2, WIDTH).lane_index
    )
    assert list(label_problems(labels, np.full(400, 0.157), 2, WIDTH)) == []
    (problem,) = label_problems(labels, np.zeros(400), 2, WIDTH)
    assert "do not follow from the offset" in problem
