"""Draws the golden image, a road for which every model card states the model's outputs."""

import numpy as np
from numpy.typing import NDArray

SKY, GRASS, ASPHALT, PAINT = (150, 180, 220), (70, 110, 60), (95, 95, 100), (230, 230, 225)


def golden_image(width: int, height: int) -> NDArray[np.uint8]:
    """Draw a straight one-lane road under a clear sky, uint8 RGB (height, width, 3).

    The card of a model states the model's outputs for this image; the service compares its own
    outputs with them at start. The image is computed in integers, so that it is the same on every
    machine.
    """
    image = np.empty((height, width, 3), np.uint8)
    horizon = height // 2
    image[:horizon] = SKY
    image[horizon:] = GRASS
    # Twice the offset from the middle column, and twice the half width of the road in each row. The
    # width of a flat road increases linearly below the horizon.
    offset = np.abs(2 * np.arange(width) - (width - 1))[None, :]
    depth = np.arange(1, height - horizon + 1)[:, None]
    half_width = depth * 5 * width // (3 * (height - horizon))
    road = image[horizon:]
    road[offset <= half_width] = ASPHALT
    painted = (offset <= half_width * 8 // 10) & (offset >= half_width * 76 // 100)
    road[painted] = PAINT
    return image
