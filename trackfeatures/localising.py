"""Localisation: from distances to markings to the offset from the centre of the lane."""

import numpy as np
from numpy.typing import ArrayLike, NDArray


def localise(distances: ArrayLike) -> NDArray[np.float64]:
    """`to_lane_centre` (N,) in m, left positive, NaN where nothing is seen, of distances (N, 5).

    The in-lane pair wins. Else the lane lies on the car's side of the marking `m` it drives on;
    outside the road it is the only lane next to that marking. The same rule for one moment is
    `TrackFeatures.to_lane_centre`.
    """
    ml, mr, l, m, r = np.atleast_2d(np.asarray(distances, dtype=np.float64)).T
    in_lane = (ml + mr) / 2
    right_lane, left_lane = (m + r) / 2, (l + m) / 2
    first = np.where(m <= 0, right_lane, left_lane)
    second = np.where(m <= 0, left_lane, right_lane)
    on_marking = np.where(np.isnan(first), second, first)
    nearest: NDArray[np.float64] = np.where(np.isnan(in_lane), on_marking, in_lane)
    return nearest
