"""One image every model has answered before it was published: the service asks it again at start.

Free of torch. Drawn in integers, so that it has the same bits on every machine.
"""

import numpy as np
from numpy.typing import NDArray

SKY, GRASS, ASPHALT, PAINT = (150, 180, 220), (70, 110, 60), (95, 95, 100), (230, 230, 225)


def golden_image(width: int, height: int) -> NDArray[np.uint8]:
    """A straight one-lane road under a clear sky, uint8 RGB (height, width, 3)."""
    image = np.empty((height, width, 3), np.uint8)
    horizon = height // 2
    image[:horizon] = SKY
    image[horizon:] = GRASS
    # Twice the offset from the middle column, and the road's half width in that row: it grows
    # linearly from the horizon down, as a flat road's does.
    offset = np.abs(2 * np.arange(width) - (width - 1))[None, :]
    depth = np.arange(1, height - horizon + 1)[:, None]
    half_width = depth * 5 * width // (3 * (height - horizon))
    road = image[horizon:]
    road[offset <= half_width] = ASPHALT
    painted = (offset <= half_width * 8 // 10) & (offset >= half_width * 76 // 100)
    road[painted] = PAINT
    return image
