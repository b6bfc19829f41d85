"""Shadows lying on the road: one mask over (s, y), 0 in the sun to 255 in the shade.

The mask is folded into bands of `band_texels` along s, each with `GUARD` texels more on both
sides, BAND_ROWS rows high and centred on y = 0, so that a long track fits one texture.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from simulator.track.road import Road

ALONG_M, ACROSS_M = 0.25, 0.25
GUARD, BAND_ROWS, BAND_TEXELS = 8, 128, 4080


@dataclass(frozen=True)
class ShadeMask:
    """The folded mask `texels` (bands * BAND_ROWS, band_texels + 2 GUARD)."""

    texels: NDArray[np.uint8]
    along_m: float
    across_m: float
    band_texels: int
    bands: int

    @classmethod
    def empty(cls, road: Road) -> "ShadeMask":
        """No shadow anywhere."""
        columns = max(1, round(road.track.length_m / ALONG_M))
        bands = -(-columns // BAND_TEXELS)
        texels = np.zeros((bands * BAND_ROWS, BAND_TEXELS + 2 * GUARD), dtype=np.uint8)
        return cls(texels, road.track.length_m / columns, ACROSS_M, BAND_TEXELS, bands)
