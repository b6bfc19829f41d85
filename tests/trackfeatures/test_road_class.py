"""Tests the rule that determines the class of the road."""

import pytest

import trackfeatures as tf


@pytest.mark.parametrize(
    ("here", "ahead", "expected"),
    [
        (1 / 169, -1 / 50, tf.RoadClass.LEFT),
        (-1 / 169, 1 / 50, tf.RoadClass.RIGHT),
        (1 / 171, -1 / 50, tf.RoadClass.RIGHT),
        (0.0, 1 / 100, tf.RoadClass.LEFT),
        (1 / 171, -1 / 171, tf.RoadClass.STRAIGHT),
    ],
)
def test_heading_class_looks_ahead_only_on_straights(
    here: float, ahead: float, expected: tf.RoadClass
) -> None:
    assert tf.classify_heading(here, ahead) == expected
