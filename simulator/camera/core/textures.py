"""Pictures made once a process: tileable noise. Nothing is downloaded, and every process makes
the same bits."""

import numpy as np
from numpy.typing import NDArray

NOISE_SIZE = 256


def noise_tile() -> NDArray[np.uint8]:
    """Tileable RGBA noise (256, 256, 4): grain, fine patches, broad patches, crack lines."""
    rng = np.random.default_rng(20240607)
    grain = _levelled(_filtered(rng, 0.35))
    fine = _levelled(_filtered(rng, 1.15))
    broad = _levelled(_filtered(rng, 1.7))
    ridges = 1.0 - np.abs(2.0 * _levelled(_filtered(rng, 1.45)) - 1.0)
    tile = np.stack([grain, fine, broad, ridges], axis=-1)
    return np.rint(tile * 255.0).astype(np.uint8)


def _filtered(rng: np.random.Generator, power: float) -> NDArray[np.float64]:
    """Noise whose amplitude falls with frequency to `power`; periodic, so it tiles."""
    frequency = np.hypot(*np.meshgrid(np.fft.fftfreq(NOISE_SIZE), np.fft.fftfreq(NOISE_SIZE)))
    frequency[0, 0] = 1.0
    weight = (frequency * NOISE_SIZE) ** -power
    weight[0, 0] = 0.0
    spectrum = np.fft.fft2(rng.standard_normal((NOISE_SIZE, NOISE_SIZE)))
    return np.asarray(np.fft.ifft2(spectrum * weight).real)


def _levelled(field: NDArray[np.float64]) -> NDArray[np.float64]:
    """Values spread evenly over [0, 1]: the rank of each."""
    rank = np.empty(field.size)
    rank[np.argsort(field, axis=None, kind="stable")] = np.linspace(0.0, 1.0, field.size)
    return rank.reshape(field.shape)
