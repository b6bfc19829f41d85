"""Shadows lying on the road: one mask over (s, y), 0 in the sun to 255 in the shade.

The mask is folded into bands of `band_texels` along s, each with `GUARD` texels more on both
sides, BAND_ROWS rows high and centred on y = 0, so that a long track fits one texture.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from simulator.track.road import Road

FloatArray = NDArray[np.float64]

ALONG_M, ACROSS_M = 0.25, 0.25
LOOK_M = 30.0
GUARD, BAND_ROWS, BAND_TEXELS = 8, 128, 4080


@dataclass(frozen=True)
class ShadeMask:
    """The folded mask `texels` (bands * BAND_ROWS, band_texels + 2 GUARD)."""

    texels: NDArray[np.uint8]
    along_m: float
    across_m: float
    band_texels: int
    bands: int
    columns: int
    """Texels once round the track."""

    @classmethod
    def empty(cls, road: Road) -> "ShadeMask":
        """No shadow anywhere."""
        columns = max(1, round(road.track.length_m / ALONG_M))
        bands = -(-columns // BAND_TEXELS)
        texels = np.zeros((bands * BAND_ROWS, BAND_TEXELS + 2 * GUARD), dtype=np.uint8)
        return cls(texels, road.track.length_m / columns, ACROSS_M, BAND_TEXELS, bands, columns)

    def rows(self, s: FloatArray) -> NDArray[np.uint8]:
        """The mask across the road at places s: (len(s), BAND_ROWS), from right to left."""
        column = np.mod((s / self.along_m).astype(np.int64), self.columns)
        band, within = np.divmod(column, self.band_texels)
        folded = self.texels.reshape(self.bands, BAND_ROWS, -1)
        return np.asarray(folded[band, :, within + GUARD])

    def fraction(self, s: float, half_width: float) -> float:
        """Share in shadow of the road within `half_width` of its centre, LOOK_M ahead of s."""
        ahead = s + self.along_m * np.arange(int(LOOK_M / self.along_m))
        reach = min(int(half_width / self.across_m), BAND_ROWS // 2)
        middle = BAND_ROWS // 2
        part = self.rows(ahead)[:, middle - reach : middle + reach]
        return float(np.mean(part >= 128))
