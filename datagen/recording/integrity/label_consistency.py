"""Whether recorded labels follow from the offset that was recorded beside them.

Labels are read as float32. At the border of a measuring system, or of a lane, that little decides
which of them applies: a label is right when it is right for a place within TOLERANCE_M.
"""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

import trackfeatures as tf
from datagen.recording.labels import Labels

TOLERANCE_M = 1e-4
SHIFTS_M = (0.0, -TOLERANCE_M, TOLERANCE_M)


def disagreements(labels: Labels, lanes: int, lane_width_m: float) -> Iterator[str]:
    """What contradicts the definitions in the labels of one round, one line a kind."""
    try:
        tf.check_lanes(lanes, lane_width_m)
    except (tf.UserError, TypeError) as error:
        yield f"its header tells of an impossible road: {error}"
        return
    count = len(labels)
    if other := int((labels.lanes != lanes).sum()):
        yield f"{other} of {count} labels do not have the {lanes} lanes of the round"
    if wrong := sum(not _distances_follow(labels, i, lanes, lane_width_m) for i in range(count)):
        yield f"{wrong} of {count} labels do not follow from the offset recorded beside them"
    if wrong := sum(not _lane_follows(labels, i, lanes, lane_width_m) for i in range(count)):
        yield f"{wrong} of {count} lane indices do not follow from the offset recorded beside them"
    if wrong := count - int(_centre_follows(labels).sum()):
        yield f"{wrong} of {count} lane-centre offsets do not follow from the distances"


def _distances_follow(labels: Labels, i: int, lanes: int, lane_width_m: float) -> bool:
    place, found = float(labels.to_middle[i]), labels.distances[i]
    if not np.isfinite(place):
        return False
    for shift in SHIFTS_M:
        values = tf.measure(place + shift, 0.0, 0.0, 0.0, lanes, lane_width_m).distances.values()
        expected = np.array([np.nan if d is None else d for d in values])
        if _same(expected, found, TOLERANCE_M + abs(shift)).all():
            return True
    return False


def _lane_follows(labels: Labels, i: int, lanes: int, lane_width_m: float) -> bool:
    place = float(labels.to_middle[i])
    return np.isfinite(place) and any(
        tf.lane_index(place + shift, lanes, lane_width_m) == labels.lane_index[i]
        for shift in SHIFTS_M
    )


def _centre_follows(labels: Labels) -> NDArray[np.bool_]:
    follows = np.zeros(len(labels), dtype=np.bool_)
    for shift in SHIFTS_M:
        expected = tf.localise(labels.distances.astype(np.float64) + shift)
        follows |= _same(expected, labels.to_lane_centre, TOLERANCE_M + abs(shift))
    return follows


def _same(
    expected: NDArray[np.float64], found: NDArray[np.float32], tolerance: float
) -> NDArray[np.bool_]:
    """Both absent, or both there and close."""
    absent = np.isnan(expected) & np.isnan(found)
    same: NDArray[np.bool_] = absent | (np.abs(expected - found) <= tolerance)
    return same
