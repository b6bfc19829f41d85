"""Reads the lane markings recorded with an image from its annotations, as polylines in pixels.

In the polylines, whole numbers are the centres of pixels. Foxglove's annotations count pixels from
the upper left corner of the image. `CORNER_PX` is the difference between both coordinates.
"""

import numpy as np
from foxglove_schemas_protobuf.ImageAnnotations_pb2 import ImageAnnotations
from foxglove_schemas_protobuf.PointsAnnotation_pb2 import PointsAnnotation
from google.protobuf.message import DecodeError
from numpy.typing import NDArray

from ..mcap.protobuf_wire import POINT2, bytes_fields

LINES = ImageAnnotations.POINTS_FIELD_NUMBER
POINTS = PointsAnnotation.POINTS_FIELD_NUMBER
TAG = POINTS << 3 | 2
CORNER_PX = 0.5


def read_polylines(message: memoryview) -> list[NDArray[np.float64]]:
    """Read the polylines of an ImageAnnotations message in their order, each (n, 2): x, y in
    pixels.

    Each point takes 20 bytes, and all points are read as one array instead of one protobuf object
    each. Raises ValueError when the message is damaged.
    """
    return [_points(message[start:end]) for start, end in bytes_fields(message, LINES)]


def _points(line: memoryview) -> NDArray[np.float64]:
    first = next(bytes_fields(line, POINTS), None)
    if first is None:
        return np.zeros((0, 2))
    start = first[0] - 2  # tag and length of the point have one byte each
    found = np.frombuffer(line[start:], POINT2, (len(line) - start) // POINT2.itemsize)
    alike = (found["tag"] == TAG) & (found["length"] == POINT2.itemsize - 2)
    count = len(alike) if alike.all() else int(alike.argmin())
    after = start + count * POINT2.itemsize
    if after < len(line) and line[after] == TAG:  # protobuf leaves out a coordinate of 0
        return _slowly(line)
    return np.column_stack([found["x"][:count], found["y"][:count]]) - CORNER_PX


def _slowly(line: memoryview) -> NDArray[np.float64]:
    try:
        points = PointsAnnotation.FromString(bytes(line)).points
    except DecodeError as error:
        raise ValueError(f"a polyline is damaged ({error})") from error
    return np.array([(point.x, point.y) for point in points]).reshape(-1, 2) - CORNER_PX
