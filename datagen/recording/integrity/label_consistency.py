"""Checks that recorded labels follow from the lateral offset recorded with them.

Labels are read as float32. At the border of a measuring system or of a lane, rounding decides which
one applies, so a label is right if it is right for some offset within TOLERANCE_M.
"""

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

import trackfeatures as tf
from datagen.recording.labels import Labels
from trackfeatures.measurement import LineOffsets

TOLERANCE_M = 1e-4
SHIFTS_M = (0.0, -TOLERANCE_M, TOLERANCE_M)
MAX_HEIGHT_M = 1.0
"""Largest height of the centre of gravity above the road plane. Distances are measured from its
foot on the road plane, but `to_middle` is recorded vertically below it. The two differ by the
height times the tangent of the banking, which the roll angle shows; the suspension adds to the
roll, and a jump to the height."""
FOOT_SLACK_M = 0.005

_Lines = tuple[int, float, LineOffsets]
"""Number of lanes, their width in m, and line offsets as in `trackfeatures.measure`."""


def label_problems(
    labels: Labels,
    roll: NDArray[np.float64],
    lanes: int,
    lane_width_m: float,
    line_offsets: LineOffsets = (),
) -> Iterator[str]:
    """Contradictions to the definitions in the labels of one round, one line per kind.

    `roll` (N,): the car's roll, rad; it bounds the position of the car's foot on a banked road.
    """
    try:
        tf.check_lanes(lanes, lane_width_m)
    except (tf.UserError, TypeError) as error:
        yield f"its header has an impossible road: {error}"
        return
    count = len(labels)
    if wrong := int((labels.lanes != lanes).sum()):
        yield f"{wrong} of {count} labels do not have the {lanes} lanes of the round"
    reach = MAX_HEIGHT_M * np.tan(np.abs(roll)) + FOOT_SLACK_M
    road = lanes, lane_width_m, line_offsets
    wrong = sum(not _distances_follow(labels, i, reach[i], road) for i in range(count))
    if wrong:
        yield f"{wrong} of {count} labels do not follow from the offset recorded beside them"
    if wrong := sum(not _lane_follows(labels, i, lanes, lane_width_m) for i in range(count)):
        yield f"{wrong} of {count} lane indices do not follow from the offset recorded beside them"
    if wrong := count - int(_centre_follows(labels).sum()):
        yield f"{wrong} of {count} lane-centre offsets do not follow from the distances"


def _distances_follow(labels: Labels, i: int, reach_m: float, road: _Lines) -> bool:
    """Whether all distances of a frame belong to one foot within reach of the recorded offset."""
    offset, found = float(labels.to_middle[i]), labels.distances[i].astype(np.float64)
    if not np.isfinite(offset):
        return False
    gaps = found - _expected(offset, road)
    if np.isnan(gaps).all():  # a limit of the measuring systems may lie between the two
        feet = np.linspace(-reach_m, reach_m, 41)
    else:
        feet = np.array([0.0, np.nanmedian(gaps)])
    return any(
        _close(_expected(offset + foot + shift, road), found, 2 * TOLERANCE_M).all()
        for foot in feet[np.abs(feet) <= reach_m]
        for shift in SHIFTS_M
    )


def _expected(offset: float, road: _Lines) -> NDArray[np.float64]:
    """The distances (5,) at an offset from the track's centre (m), NaN where absent."""
    values = tf.measure(offset, 0.0, 0.0, 0.0, *road).distances.values()
    return np.array([np.nan if d is None else d for d in values])


def _lane_follows(labels: Labels, i: int, lanes: int, lane_width_m: float) -> bool:
    offset = float(labels.to_middle[i])
    return np.isfinite(offset) and any(
        tf.lane_index(offset + shift, lanes, lane_width_m) == labels.lane_index[i]
        for shift in SHIFTS_M
    )


def _centre_follows(labels: Labels) -> NDArray[np.bool_]:
    follows = np.zeros(len(labels), dtype=np.bool_)
    for shift in SHIFTS_M:
        expected = tf.localise(labels.distances.astype(np.float64) + shift)
        follows |= _close(expected, labels.to_lane_centre, TOLERANCE_M + abs(shift))
    return follows


def _close(
    expected: NDArray[np.float64], found: NDArray[np.floating[Any]], tolerance: float
) -> NDArray[np.bool_]:
    """Mask: both are NaN, or both are present and differ by at most `tolerance`."""
    absent = np.isnan(expected) & np.isnan(found)
    same: NDArray[np.bool_] = absent | (np.abs(expected - found) <= tolerance)
    return same
