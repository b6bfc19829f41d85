"""Encodes features in m and rad as the six training targets of the network, and decodes them.

`y = 0.1 + 0.8 (x - lo) / (hi - lo)`, clipped to [0, 1]; the columns are in the order of `TARGETS`.
An absent distance is NaN in m and is encoded as the end of its range that is farther from the car.
An unknown distance is infinite in m and is encoded as NaN.
"""

import math
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from trackfeatures.definitions import MARKINGS, RANGES, TARGETS, TrackFeatures
from trackfeatures.road_class import UNKNOWN_HEADING, RoadClass

OFFSET, SPAN = 0.1, 0.8
UNKNOWN_M: Final = math.inf
"""Value of an unlabelled distance; the loss and the metrics ignore it."""
IN_LANE_WIDTH_LIMIT_M = 5.5
"""When values are decoded, `ml` and `mr` are present if `mr - ml` is below this limit."""
ON_MARKING_LIMIT_M = 2.75
"""When values are decoded, `m` is present if its value is below this limit."""
NEIGHBOUR_LIMIT_M = 6.75
"""When values are decoded, `l` or `r` is present if `m` is present and the absolute value of `l` or
`r` is below this limit."""

_LO = np.array([RANGES[name].lo for name in TARGETS])
_WIDTH = np.array([RANGES[name].hi - RANGES[name].lo for name in TARGETS])
_INACTIVE = np.array([RANGES[name].inactive for name in MARKINGS], dtype=np.float64)
_ML, _MR, _L, _M, _R, _ANGLE = range(len(TARGETS))


def encode(distances: ArrayLike, angle: ArrayLike) -> NDArray[np.float32]:
    """Return the coded targets (N, 6) of distances (N, 5) in m, NaN where absent, and angles (N,)
    in rad.

    An unknown distance (`UNKNOWN_M`) is coded as NaN.
    """
    metres = np.atleast_2d(np.asarray(distances, dtype=np.float64))
    present = np.where(np.isnan(metres), _INACTIVE, metres)
    present = np.where(np.isinf(metres), np.nan, present)
    values = np.column_stack([present, np.atleast_1d(np.asarray(angle, dtype=np.float64))])
    return _clip(OFFSET + SPAN * (values - _LO) / _WIDTH)


def decode_values(coded: ArrayLike) -> NDArray[np.float64]:
    """Return the values (N, 6) in m and rad of `coded` (N, 6). An absent distance is not detected:
    its value is an end of its range."""
    y = np.atleast_2d(np.asarray(coded, dtype=np.float64))
    values: NDArray[np.float64] = _LO + (y - OFFSET) / SPAN * _WIDTH
    return values


def decode(coded: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Decode `coded` (N, 6) to distances (N, 5) in m, NaN where absent, and angles (N,) in rad."""
    values = decode_values(coded)
    distances = values[:, :_ANGLE].copy()
    in_lane = values[:, _MR] - values[:, _ML] < IN_LANE_WIDTH_LIMIT_M
    on_marking = values[:, _M] < ON_MARKING_LIMIT_M
    distances[~in_lane, _ML : _MR + 1] = np.nan
    distances[~on_marking, _M] = np.nan
    distances[~(on_marking & (values[:, _L] > -NEIGHBOUR_LIMIT_M)), _L] = np.nan
    distances[~(on_marking & (values[:, _R] < NEIGHBOUR_LIMIT_M)), _R] = np.nan
    return distances, values[:, _ANGLE]


def encode_features(features: TrackFeatures) -> NDArray[np.float32]:
    """Return the coded targets (6,) of one set of features."""
    distances = [np.nan if d is None else d for d in features.distances.values()]
    coded: NDArray[np.float32] = encode([distances], [features.angle])[0]
    return coded


def decode_features(coded: ArrayLike, heading: RoadClass) -> TrackFeatures:
    """Return the features decoded from `coded` (6,), with the class of the road `heading`."""
    distances, angle = decode(coded)
    ml, mr, l, m, r = (None if np.isnan(d) else float(d) for d in distances[0])
    return TrackFeatures(ml, mr, l, m, r, float(angle[0]), heading)


def mirror_coded(coded: ArrayLike) -> NDArray[np.float32]:
    """Return the coded targets (N, 6) of the left-right mirrored scenes."""
    y = np.atleast_2d(np.asarray(coded, dtype=np.float64))
    swapped = 1.0 - y[:, [_MR, _ML, _R, _M, _L, _ANGLE]]
    # The range of `m` is not symmetric about 0, and an absent `m` keeps its code at the upper end.
    m = decode_values(y)[:, _M]
    mirrored_m = np.where(m < ON_MARKING_LIMIT_M, -m, m)
    swapped[:, _M] = OFFSET + SPAN * (mirrored_m - _LO[_M]) / _WIDTH[_M]
    return _clip(swapped)


def mirror_heading(heading: ArrayLike) -> NDArray[np.int64]:
    """Return the classes (N,) of the left-right mirrored scenes: LEFT and RIGHT are swapped, and
    unknown classes (UNKNOWN_HEADING) stay unknown."""
    classes = np.asarray(heading, dtype=np.int64)
    return np.where(classes == UNKNOWN_HEADING, classes, RoadClass.RIGHT - classes)


def _clip(coded: NDArray[np.float64]) -> NDArray[np.float32]:
    clipped: NDArray[np.float32] = np.clip(coded, 0.0, 1.0).astype(np.float32)
    return clipped
