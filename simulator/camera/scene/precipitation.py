"""Draws rain and snow in front of the camera as short streaks.

The drops have fixed positions in a box of air that repeats through the world, so they pass the
camera as it moves. The distance that they have fallen is a hash of the camera position, because
there is no clock: the same pose gives the same drops. World frame, metres.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from simulator.camera.core.context import Graphics
from simulator.camera.core.optics import Eye
from simulator.camera.scene.light import Light

CAR_SPEED = 15.0
"""Assumed speed of the car in m/s; it determines the slant of the streaks."""


@dataclass(frozen=True)
class Drops:
    """Parameters of rain or snow: side of the box of air (m), number of drops in it at the highest
    density, fall speed (m/s), exposure time (s), width (m) and opacity (0 to 1) of a drop."""

    box_m: float
    most: int
    speed: float
    shutter_s: float
    width_m: float
    alpha: float


RAIN = Drops(box_m=9.0, most=2200, speed=8.0, shutter_s=1 / 50, width_m=0.007, alpha=0.5)
SNOW = Drops(box_m=14.0, most=4500, speed=1.3, shutter_s=1 / 200, width_m=0.045, alpha=0.95)
_CORNERS = np.array([[-1, 0], [1, 0], [-1, 1], [-1, 1], [1, 0], [1, 1]], dtype=np.float32)


class Precipitation:
    """The rain or snow of one scene; it is drawn after everything else."""

    def __init__(self, graphics: Graphics, light: Light, seed: int) -> None:
        self._drops = SNOW if light.weather == "snow" else RAIN
        rng = np.random.default_rng([seed, 7])
        count = round(self._drops.most * light.falling)
        vertices = np.empty((count, 6, 6), dtype=np.float32)
        vertices[:, :, :4] = rng.uniform(0.0, 1.0, (count, 1, 4))
        vertices[:, :, 4:] = _CORNERS
        self._count = count * 6
        wind = rng.normal(0.0, 1.2, 2)
        self._velocity = np.array([wind[0], wind[1], -self._drops.speed])
        drops = graphics.context.buffer(vertices.tobytes())
        program = graphics.programs["precipitation"]
        self._array = graphics.context.vertex_array(program, [(drops, "4f 2f", "at", "corner")])
        self._uniforms = {
            name: graphics.uniform("precipitation", name) for name in ("shift", "streak", "shape")
        }

    def draw(self, eye: Eye, focal_px: float) -> None:
        """Draw the drops in front of `eye`; `focal_px` (px) is the focal length. Blending must be
        enabled."""
        drops = self._drops
        shift = np.append(-eye.place, 0.0) / drops.box_m
        shift[2] += _fall_phase(eye.place)
        ahead = eye.axes[2] * CAR_SPEED
        streak = (self._velocity - ahead) * drops.shutter_s
        self._uniforms["shift"].value = tuple((shift % 1.0).tolist())
        self._uniforms["streak"].value = (*streak.tolist(), drops.box_m)
        self._uniforms["shape"].value = (drops.width_m, 0.8 / focal_px, drops.alpha)
        self._array.render(vertices=self._count)


def _fall_phase(place: NDArray[np.float64]) -> float:
    """Return the fallen distance as a share of the box. It is a hash of `place`, the camera
    position, in mm."""
    x, y, z = (round(float(v) * 1000.0) for v in place)
    mixed = (x * 73_856_093) ^ (y * 19_349_663) ^ (z * 83_492_791)
    return math.fmod((mixed % 1_000_003) * 0.6180339887498949, 1.0)
