"""The texture features, compared with the same means computed pixel by pixel in numpy."""

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from mtlnet.model.textures import (
    CELL_ROWS,
    CELL_VALUES,
    CENTRE_BANDS,
    CENTRE_COLUMNS,
    LIGHT_VALUES,
    PLANES,
    SQRT_EPSILON,
    TEXTURE_VALUES,
    band_sums,
    light_features,
    texture_features,
)
from tests.mtlnet.conftest import draw_road


def oracle(image: NDArray[np.uint8]) -> NDArray[np.float64]:
    """Texture features (C + M,) of an image, from normalised pixels in float64."""
    pixels = image / 127.5 - 1
    grey = pixels.mean(2, keepdims=True)
    across = np.abs(np.diff(grey, axis=1, append=grey[:, -1:]))
    down = np.abs(np.diff(grey, axis=0, append=grey[-1:]))
    planes = np.concatenate([pixels, across, down], 2)
    narrow = planes.reshape(42, 5, 8, 35, PLANES).mean((1, 3))
    cells = narrow.reshape(CELL_ROWS, 3, 8, PLANES).mean(1)
    parts = [cells, narrow[CENTRE_BANDS, CENTRE_COLUMNS].copy()]
    for part in parts:
        part[..., 3:] = np.sqrt(part[..., 3:] + SQRT_EPSILON)
    return np.concatenate([part.transpose(2, 0, 1).reshape(-1) for part in parts])


def images() -> NDArray[np.uint8]:
    rng = np.random.default_rng(4)
    noise = rng.integers(0, 256, (2, 210, 280, 3), np.uint8)
    white = np.full((210, 280, 3), 255, np.uint8)
    return np.stack([*noise, white, draw_road(0.4, 0.03)])


def test_textures_are_the_means_of_the_pixels() -> None:
    found = texture_features(torch.from_numpy(images())).numpy()
    assert found.shape == (4, TEXTURE_VALUES)
    for row, image in zip(found, images(), strict=True):
        np.testing.assert_allclose(row, oracle(image), rtol=2e-6, atol=5e-7)


def test_sums_of_bands_are_exact() -> None:
    pixels = images()
    sums, count = band_sums(torch.from_numpy(pixels))
    assert count == 5 * 35
    grey = pixels.astype(np.int64).sum(3)
    across = np.abs(np.diff(grey, axis=2, append=grey[:, :, -1:]))
    down = np.abs(np.diff(grey, axis=1, append=grey[:, -1:]))
    planes = np.concatenate([pixels.transpose(0, 3, 1, 2), np.stack([across, down], 1)], 1)
    exact = planes.reshape(4, PLANES, 42, 5, 8, 35).sum((3, 5))
    np.testing.assert_array_equal(sums.numpy(), exact)


def test_light_is_the_mean_of_each_half() -> None:
    textures = texture_features(torch.from_numpy(images()))
    halves = textures[:, :CELL_VALUES].numpy().reshape(4, PLANES, 2, 7 * 8)
    expected = halves.mean(3).reshape(4, LIGHT_VALUES)
    assert light_features(textures).numpy() == pytest.approx(expected, rel=1e-5, abs=1e-6)
