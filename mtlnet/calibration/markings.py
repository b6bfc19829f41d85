"""Finds bright or yellow bars in the rows of a road picture, and the segments that they form.

In an image row that is n rows below the horizon, a marking is n w / h px wide, whatever its
direction; w is the width of its paint and h the height of the camera, both in m. Pixels: u to the
right, v down, pixel centres at whole numbers.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

MAX_WIDTH = 0.3
"""Maximum width of a bar in px, divided by the number of rows between the bar and the horizon. The
limit is reached by paint 0.36 m wide for a camera 1.2 m above the road."""
MARGIN_PX = 2.0
MIN_CONTRAST = 14.0
"""Least difference in grey levels by which a bar is brighter (or yellower) than both its sides."""
BAND_PX = 20
"""Maximum number of rows of a segment, short enough to be straight in a bend."""
MIN_ROWS = 6
MAX_RESIDUAL_PX = 1.0

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class Segments:
    """N straight segments of markings in a picture, as arrays (N,): position `u`, `v` of the middle
    (px), `slope` du/dv and its standard deviation, and number of `rows` that the segment covers."""

    u: FloatArray
    v: FloatArray
    slope: FloatArray
    slope_std: FloatArray
    rows: FloatArray

    def __len__(self) -> int:
        return len(self.u)


def find_segments(picture: NDArray[np.uint8], horizon_px: float) -> Segments:
    """Find the bright or yellow bars in an RGB picture (H, W, 3), and return the straight segments
    that they form. `horizon_px`: estimated row of the horizon, on which the expected width of the
    bars depends."""
    height = len(picture)
    top = int(np.clip(horizon_px + 0.02 * height, 0, height - MIN_ROWS))
    below = cv2.GaussianBlur(picture[top:], (3, 3), 0.0).astype(np.float32)
    bright = 0.5 * (below[..., 0] + below[..., 1])
    yellow = 1.5 * (bright - below[..., 2])
    reach = MAX_WIDTH * (np.arange(top, height, dtype=np.float64) - horizon_px) + MARGIN_PX
    response = np.maximum(_bars(bright, reach), _bars(yellow, reach))
    return _segments(response, top, reach)


def _bars(level: NDArray[np.float32], reach: FloatArray) -> NDArray[np.float32]:
    """Return the grey level of each pixel minus the larger grey level of two pixels, `reach`
    (rows,) px to its left and to its right; 0 where one of these two is outside the picture."""
    width = level.shape[1]
    columns = np.arange(width)
    shift = np.rint(reach).astype(np.int64)[:, None]
    left = np.take_along_axis(level, np.maximum(columns - shift, 0), axis=1)
    right = np.take_along_axis(level, np.minimum(columns + shift, width - 1), axis=1)
    response = level - np.maximum(left, right)
    inside = (columns >= shift) & (columns < width - shift)
    return np.where(inside, response, 0.0).astype(np.float32)


def _segments(response: NDArray[np.float32], top: int, reach: FloatArray) -> Segments:
    """Fit straight segments to the bars in `response` (rows, columns). `top`: the picture's row
    that is the first row of `response`; `reach` (rows,): maximum width of a bar in each row, px."""
    noise = 1.4826 * float(np.median(np.abs(response)))
    mask = response > max(MIN_CONTRAST, 2.0 * noise)
    _, labels = cv2.connectedComponents(mask.astype(np.uint8), connectivity=8)
    v, u = np.nonzero(mask)
    weight = response[v, u].astype(np.float64)
    # One centre per row and component: sums over its pixels.
    key, place = np.unique(labels[v, u].astype(np.int64) * len(response) + v, return_inverse=True)
    total = np.bincount(place, weight)
    centre = np.bincount(place, weight * u) / total
    pixels = np.bincount(place)
    label, row = np.divmod(key, len(response))
    whole = pixels <= reach[row]
    label, row, centre = label[whole], row[whole], centre[whole]
    bands = len(response) // BAND_PX + 1
    _, piece = np.unique(label * bands + row // BAND_PX, return_inverse=True)
    return _fit_lines(piece, row + top, centre)


def _fit_lines(piece: NDArray[np.int64], v: NDArray[np.int64], u: FloatArray) -> Segments:
    """Fit a line u(v) by least squares to the points (u, v), px, of each piece; drop short or
    curved pieces. `piece` (points,): number of the piece to which a point belongs."""
    n = np.bincount(piece).astype(np.float64)
    mean_u, mean_v = np.bincount(piece, u) / n, np.bincount(piece, v) / n
    du, dv = u - mean_u[piece], v - mean_v[piece]
    spread = np.bincount(piece, dv * dv)
    slope = np.bincount(piece, du * dv) / np.maximum(spread, 1e-9)
    residual = np.sqrt(np.bincount(piece, (du - slope[piece] * dv) ** 2) / np.maximum(n - 2.0, 1.0))
    good = (n >= MIN_ROWS) & (residual < MAX_RESIDUAL_PX)
    error = np.maximum(residual, 0.3) / np.sqrt(np.maximum(spread, 1e-9))
    return Segments(mean_u[good], mean_v[good], slope[good], error[good], n[good])
