"""Finds the film's vanishing point, to which most segments of markings point, within half a degree.

On bends, during lane changes and for objects that do not lie along the road, the intersections of
the segments are scattered; during straight driving they coincide.
"""

from collections.abc import Iterable

import cv2
import numpy as np

from mtlnet.calibration.road_fit import MAX_SLOPE, MIN_BELOW, Lines

STEP_DEG = 0.25
REACH_DEG = (16.0, 13.0)
"""Range of yaw and pitch that is searched, degrees to both sides."""
POINTING_STD = 0.01
SMOOTHING_CELLS = 2.0


def find_vanishing_point(pictures: Iterable[Lines]) -> tuple[float, float] | None:
    """Return the vanishing point x0, y0, in normalised coordinates, of the segments of all
    pictures; None if no segment points into the searched range: 16 degrees to the left and right,
    13 degrees up and down."""
    across, down = (np.arange(-reach, reach + STEP_DEG / 2, STEP_DEG) for reach in REACH_DEG)
    y0 = np.tan(np.radians(down))
    votes = np.zeros((len(down), len(across)))
    for lines in pictures:
        below = lines.y[:, None] - y0
        x0 = lines.x[:, None] - lines.slope[:, None] * below
        column = np.rint((np.degrees(np.arctan(x0)) - across[0]) / STEP_DEG)
        std = np.hypot(POINTING_STD, lines.slope_std[:, None] * below)
        usable = (below > MIN_BELOW) & (np.abs(lines.slope) < MAX_SLOPE)[:, None]
        usable &= (column >= 0) & (column < len(across))
        row, place = np.nonzero(usable)[1], column[usable].astype(np.int64)
        weight = (lines.size[:, None] / std)[usable]
        cells = np.bincount(row * len(across) + place, weight, votes.size)
        votes += cells.reshape(votes.shape)
    smooth = cv2.GaussianBlur(votes, (0, 0), SMOOTHING_CELLS)
    if not smooth.any():
        return None
    best_row, best_place = divmod(int(np.argmax(smooth)), len(across))
    return float(np.tan(np.radians(across[best_place]))), float(y0[best_row])
