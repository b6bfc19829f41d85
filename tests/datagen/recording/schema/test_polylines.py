"""Polylines of image annotations: our reader agrees with the protobuf library."""

import numpy as np
import pytest
from foxglove_schemas_protobuf.ImageAnnotations_pb2 import ImageAnnotations
from foxglove_schemas_protobuf.PointsAnnotation_pb2 import PointsAnnotation
from numpy.typing import NDArray

from datagen.recording.schema.polylines import read_polylines

LINES = [
    np.array([[1.5, 200.25], [-3.0, 150.0], [140.0, 105.5]]),
    np.array([[0.0, 0.0], [7.0, 0.0], [0.0, 9.5]]),  # protobuf does not encode zeros
    np.zeros((0, 2)),
    np.random.default_rng(0).normal(0, 1e3, (60, 2)),
]


def message(lines: list[NDArray[np.float64]]) -> bytes:
    """A message as a recorder writes it: lines of points and colours, and a line of text."""
    made = ImageAnnotations()
    for line in lines:
        added = made.points.add(type=PointsAnnotation.LINE_STRIP, thickness=1.0)
        added.timestamp.FromSeconds(1_577_836_800)
        added.outline_color.g = 1.0
        for x, y in line.tolist():
            added.points.add(x=x, y=y)
    made.texts.add(text="ml -1.90 mr 2.10")
    return bytes(made.SerializeToString())


def test_polylines_are_read_back() -> None:
    found = read_polylines(memoryview(message(LINES)))
    assert len(found) == len(LINES)
    for got, expected in zip(found, LINES, strict=True):
        np.testing.assert_array_equal(got, expected - 0.5)  # annotations count from the corner
    assert read_polylines(memoryview(message([]))) == []


def test_a_truncated_message_is_refused() -> None:
    whole = message(LINES[:1])
    for length in (1, len(whole) // 2, len(whole) - 1):
        with pytest.raises(ValueError, match="damaged"):
            read_polylines(memoryview(whole[:length]))
