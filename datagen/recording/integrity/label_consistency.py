"""Checks that recorded labels follow from the lateral offset recorded with them.

Labels are rounded to float32. Near the limits of the in-lane and on-marking systems and of a lane,
rounding decides which system or lane applies. So a label is accepted if it is right for any offset
within 0.1 mm (TOLERANCE_M) of the recorded offset.
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
"""Largest height (m) of the centre of gravity above the road plane, also in a jump. Distances are
measured from the nearest point of the road plane (the foot), but `to_middle` is the lateral offset
of the centre of gravity itself. On a banked road, the lateral offsets of the foot and of the centre
of gravity differ by the height times the tangent of the banking. The car's roll angle is used as
the banking."""
FOOT_SLACK_M = 0.005
"""Tolerance (m) added to the lateral distance between the foot and the centre of gravity."""

_Lines = tuple[int, float, LineOffsets]
"""Number of lanes, lane width (m), and for each marking the offsets (m) of its leftmost and its
rightmost line."""


def label_problems(
    labels: Labels,
    roll: NDArray[np.float64],
    lanes: int,
    lane_width_m: float,
    line_offsets: LineOffsets = (),
) -> Iterator[str]:
    """Yield a line for each kind of contradiction between a round's labels and the definitions.

    `roll` (N,) is the car's roll in rad. On a banked road it limits the lateral distance between
    the centre of gravity and the nearest point of the road plane. `lanes` is the round's number of
    lanes, and `lane_width_m` their width (m). `line_offsets` are the offsets (m) of the painted
    lines of each marking from its nominal position; () means that all offsets are 0.
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
    """Return whether all distances of frame `i` follow from one lateral position on `road`. This
    position may differ from the recorded offset by at most `reach_m` (m)."""
    offset, found = float(labels.to_middle[i]), labels.distances[i].astype(np.float64)
    if not np.isfinite(offset):
        return False
    gaps = found - _expected(offset, road)
    if np.isnan(gaps).all():  # the two positions can lie in different systems of distances
        feet = np.linspace(-reach_m, reach_m, 41)
    else:
        feet = np.array([0.0, np.nanmedian(gaps)])
    return any(
        _close(_expected(offset + foot + shift, road), found, 2 * TOLERANCE_M).all()
        for foot in feet[np.abs(feet) <= reach_m]
        for shift in SHIFTS_M
    )


def _expected(offset: float, road: _Lines) -> NDArray[np.float64]:
    """Return the five distances (5,) in m at the lateral `offset` (m) from the centre of `road`;
    NaN where a distance is absent."""
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
    """Return a mask of the elements of `expected` and `found` that are both NaN, or that are both
    present and differ by at most `tolerance`."""
    absent = np.isnan(expected) & np.isnan(found)
    same: NDArray[np.bool_] = absent | (np.abs(expected - found) <= tolerance)
    return same
