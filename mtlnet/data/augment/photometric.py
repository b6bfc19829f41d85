"""Augments the colour and quality of images: colour, blur, noise, JPEG artefacts.

Images are uint8 RGB (H, W, 3), changed in place with OpenCV. The operations are the same as in
torchvision.transforms.v2, which takes 3 to 30 times as long;
tests/mtlnet/data/augment/test_photometric.py compares the results.
"""

from functools import lru_cache

import cv2
import numpy as np
import simplejpeg
from numpy.typing import NDArray

BRIGHTNESS, CONTRAST, SATURATION = 0.12, 0.15, 0.2
CHANNEL_BRIGHTNESS, CHANNEL_CONTRAST = 0.04, 0.06  # additional change of each channel
LUMA = (0.299, 0.587, 0.114)  # ITU-R BT.601
STORED_NOISE_STD = 32.0  # standard deviation of the stored noise; its mean is 128


def draw_colour_transforms(count: int, rng: np.random.Generator) -> NDArray[np.float32]:
    """Return random affine colour transforms (`count`, 3, 4), from (r, g, b, 1) to (r, g, b), 0 to
    255.

    They change the saturation, then the contrast about middle grey and the brightness. The changes
    of contrast and brightness have a part for all channels and a smaller part for each channel.
    """
    saturation = 1.0 + rng.uniform(-SATURATION, SATURATION, (count, 1, 1))
    mixed = saturation * np.eye(3) + (1.0 - saturation) * np.array(LUMA)
    gain = np.exp(
        rng.uniform(-CONTRAST, CONTRAST, (count, 1, 1))
        + rng.uniform(-CHANNEL_CONTRAST, CHANNEL_CONTRAST, (count, 3, 1))
    )
    shift = rng.uniform(-BRIGHTNESS, BRIGHTNESS, (count, 1, 1)) + rng.uniform(
        -CHANNEL_BRIGHTNESS, CHANNEL_BRIGHTNESS, (count, 3, 1)
    )
    return np.concatenate([gain * mixed, 127.5 * (shift + 1.0 - gain)], 2).astype(np.float32)


def blur(image: NDArray[np.uint8], std_px: float) -> None:
    """Blur the image, in place, by a Gaussian with a standard deviation of `std_px`."""
    side = 2 * round(2 * std_px) + 1
    cv2.GaussianBlur(image, (side, side), std_px, dst=image)


def add_noise(image: NDArray[np.uint8], std: float, start: int) -> None:
    """Add normal noise with standard deviation `std`, in levels of 0 to 255, to the image, in
    place. The noise is a part of the array `stored_noise`, from index `start` on."""
    noise = stored_noise(2 * image.size)[start : start + image.size].reshape(image.shape)
    weight = std / STORED_NOISE_STD
    cv2.addWeighted(image, 1.0, noise, weight, -128.0 * weight, dst=image)


@lru_cache(maxsize=2)
def stored_noise(size: int) -> NDArray[np.uint8]:
    """Return normal noise (size,) with mean 128 and standard deviation 32. It is computed once per
    size, because new noise for each image would take most of the time."""
    drawn = np.random.default_rng(0).standard_normal(size, np.float32)
    return (128 + STORED_NOISE_STD * drawn).round().clip(0, 255).astype(np.uint8)


def compress(image: NDArray[np.uint8], quality: int) -> None:
    """Compress the image as JPEG of `quality` 0 to 100 and decode it again, in place."""
    file = simplejpeg.encode_jpeg(np.ascontiguousarray(image), quality, "RGB", "420")
    simplejpeg.decode_jpeg(file, "RGB", buffer=image)
