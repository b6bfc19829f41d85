"""Colour, blur, noise and compression match torchvision."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from torchvision.transforms.v2 import functional as vision

from mtlnet.data.augment.photometric import (
    BRIGHTNESS,
    CHANNEL_BRIGHTNESS,
    LUMA,
    add_noise,
    blur,
    compress,
)
from mtlnet.data.augment.pipeline import (
    AugmentParams,
    apply_params,
    draw_params,
)
from tests.mtlnet.data.augment.samples import picture, unchanged
from trackfeatures.camera import CameraParameters


def as_tensor(image: NDArray[np.uint8]) -> torch.Tensor:
    return torch.from_numpy(image.copy()).permute(2, 0, 1)


def colour(
    contrast: float = 1.0, brightness: float = 0.0, saturation: float = 1.0
) -> AugmentParams:
    """Parameters of one image with this colour transform; see `draw_colour_transforms`."""
    mixed = saturation * np.eye(3) + (1 - saturation) * np.array(LUMA)
    shift = np.full((3, 1), 127.5 * (brightness + 1 - contrast))
    table = np.concatenate([contrast * mixed, shift], 1)[None].astype(np.float32)
    return replace(unchanged(1), colour=table)


def test_colour_transforms_match_torchvision() -> None:
    before = picture()
    saturated, scaled = before[None].copy(), before[None].copy()
    apply_params(saturated, colour(saturation=0.5), CameraParameters())
    # torchvision rounds its luma (0.2989, 0.587, 0.114) to a whole level first.
    expected = vision.adjust_saturation(as_tensor(before), 0.5)
    assert int((as_tensor(saturated[0]).int() - expected.int()).abs().max()) <= 1
    apply_params(scaled, colour(contrast=1.3, brightness=0.3), CameraParameters())
    brighter = vision.adjust_brightness(as_tensor(before), 1.3)
    assert int((as_tensor(scaled[0]).int() - brighter.int()).abs().max()) <= 1


def test_drawn_colour_transforms_keep_middle_grey_on_average() -> None:
    table = draw_params(2000, 52, 70, np.random.default_rng(0)).colour
    grey = table @ np.array([127.5, 127.5, 127.5, 1.0], np.float32)
    assert grey.mean() == pytest.approx(127.5, abs=2.0)
    assert grey.std() == pytest.approx(
        127.5 * np.hypot(BRIGHTNESS, CHANNEL_BRIGHTNESS) / np.sqrt(3), rel=0.1
    )


def test_blur_noise_and_compression_match_torchvision() -> None:
    before = picture()
    blurred, noisy, packed = before.copy(), before.copy(), before.copy()
    blur(blurred, 1.2)
    expected = vision.gaussian_blur(as_tensor(before), [5, 5], [1.2, 1.2])
    inside = (as_tensor(blurred).int() - expected.int())[:, 3:-3, 3:-3]
    assert int(inside.abs().max()) <= 1
    add_noise(noisy, 6.0, 1234)
    added = noisy.astype(np.float64) - before
    free = (before > 40) & (before < 215)
    assert added[free].mean() == pytest.approx(0.0, abs=0.1)
    assert added[free].std() == pytest.approx(6.0, rel=0.03)
    compress(packed, 40)
    expected_jpeg = vision.jpeg(as_tensor(before), 40)
    difference = (as_tensor(packed).float() - expected_jpeg.float()).abs()
    lost = (expected_jpeg.float() - as_tensor(before).float()).abs()
    assert float(difference.mean()) < 0.2 * float(lost.mean())
    assert float(lost.mean()) > 0.5
