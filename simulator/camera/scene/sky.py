"""The sky, rendered once per scene to a panorama that every image shows on a dome.

The sky depends only on the direction, so clouds and glow need not be computed for each frame.
Panorama and dome have the same triangles, so each direction maps exactly to its texel.
"""

import math

import numpy as np
from numpy.typing import NDArray

from simulator.camera.core.context import SKY_UNIT, Graphics

SECTORS = 12
_ROWS = ((-90, 0.0), (-8, 0.02), (12, 0.32), (45, 0.70), (90, 1.0))
"""Rows of the dome, finest above the horizon: elevation (deg), panorama height (0 to 1)."""
_SHARPNESS = 0.9
"""Approximate number of texels of the panorama per pixel in the middle of the picture."""
_WIDTHS = (1024, 4096)


class Sky:
    """The sky of a scene in `weather`, for images with the focal length `focal_px`. The constructor
    renders it with the light in the uniform block `Frame`, which must be bound."""

    def __init__(self, graphics: Graphics, weather: str, focal_px: float) -> None:
        context = graphics.context
        self._texture = context.texture(_panorama_size(focal_px), 4)
        self._texture.filter = (context.LINEAR, context.LINEAR)
        self._texture.repeat_y = False
        layout = (context.buffer(_dome().tobytes()), "3f 2f", "direction", "place")
        self._array = context.vertex_array(graphics.programs["dome"], [layout])
        program = graphics.programs[graphics.weather_program("sky", weather)]
        panorama = context.framebuffer([self._texture])
        panorama.use()
        context.enable_only(context.NOTHING)
        graphics.use_textures()
        context.vertex_array(program, [layout]).render()

    def draw(self) -> None:
        """Draw the sky in the pixels that no geometry covers."""
        self._texture.use(SKY_UNIT)
        self._array.render()


def _panorama_size(focal_px: float) -> tuple[int, int]:
    """Return width and height of the panorama in texels, for pictures with the focal length
    `focal_px`."""
    wanted = 2.0 * math.pi * focal_px * _SHARPNESS
    width = int(np.clip(2 ** math.ceil(math.log2(wanted)), *_WIDTHS))
    return width, width // 4


def _dome() -> NDArray[np.float32]:
    """Return triangles round the eye, vertices (n, 5): direction, position in the panorama."""
    azimuth = np.linspace(-np.pi, np.pi, SECTORS + 1)
    elevation, height = np.radians([row[0] for row in _ROWS]), [row[1] for row in _ROWS]
    grid = np.empty((len(_ROWS), SECTORS + 1, 5), dtype=np.float32)
    grid[..., 0] = np.cos(elevation)[:, None] * np.cos(azimuth)
    grid[..., 1] = np.cos(elevation)[:, None] * np.sin(azimuth)
    grid[..., 2] = np.sin(elevation)[:, None]
    grid[..., 3] = np.arange(SECTORS + 1) / SECTORS
    grid[..., 4] = np.array(height)[:, None]
    corners = [
        grid[:-1, :-1],
        grid[:-1, 1:],
        grid[1:, :-1],
        grid[1:, :-1],
        grid[:-1, 1:],
        grid[1:, 1:],
    ]
    return np.ascontiguousarray(np.stack(corners, axis=2).reshape(-1, 5))
