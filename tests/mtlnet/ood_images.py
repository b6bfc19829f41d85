"""Out-of-distribution images: synthetic images without a road, and roads seen by other cameras."""

from collections.abc import Iterator

import cv2
import numpy as np
from numpy.typing import NDArray

from trackfeatures.camera import CameraParameters

WIDTH, HEIGHT = 280, 210
Image = NDArray[np.uint8]


def images_without_road(count: int, seed: int) -> Iterator[tuple[str, Image]]:
    """`count` images (210, 280, 3) uint8 RGB, each with the name of its kind; kinds alternate."""
    kinds = (uniform, noise, clouds, gradient, stripes, shapes, text, interior)
    for number in range(count):
        kind = kinds[number % len(kinds)]
        yield kind.__name__, kind(np.random.default_rng([seed, number]))


def uniform(rng: np.random.Generator) -> Image:
    return np.full((HEIGHT, WIDTH, 3), rng.integers(0, 256, 3), np.uint8)


def noise(rng: np.random.Generator) -> Image:
    coarse = int(rng.choice([1, 2, 5, 10]))
    small = rng.integers(0, 256, (HEIGHT // coarse + 1, WIDTH // coarse + 1, 3), dtype=np.uint8)
    return np.repeat(np.repeat(small, coarse, 0), coarse, 1)[:HEIGHT, :WIDTH].copy()


def clouds(rng: np.random.Generator) -> Image:
    """Noise at all scales, like a texture of stone or foliage."""
    total = np.zeros((HEIGHT, WIDTH, 3))
    for octave in range(1, 8):
        layer = rng.normal(size=(2**octave, 2**octave, 3)) / octave
        total += cv2.resize(layer, (WIDTH, HEIGHT), interpolation=cv2.INTER_CUBIC)
    return _full_range(total)


def gradient(rng: np.random.Generator) -> Image:
    rows, columns = np.mgrid[0:1:210j, 0:1:280j]
    direction = rng.uniform(0, 2 * np.pi)
    along = rows * np.sin(direction) + columns * np.cos(direction)
    return _full_range(along[..., None] * rng.uniform(-1, 1, 3) + rng.uniform(0, 1, 3))


def stripes(rng: np.random.Generator) -> Image:
    rows, columns = np.mgrid[:HEIGHT, :WIDTH]
    waves = np.sin(columns / rng.uniform(3, 25) + rng.uniform(0, 6))
    if rng.random() < 0.5:
        waves = waves * np.sin(rows / rng.uniform(3, 25))
    first, second = rng.integers(0, 256, (2, 3))
    image: Image = np.where(waves[..., None] > 0, first, second).astype(np.uint8)
    return image


def shapes(rng: np.random.Generator) -> Image:
    image = uniform(rng)
    for _ in range(rng.integers(5, 40)):
        colour = tuple(rng.integers(0, 256, 3).tolist())
        x, y = int(rng.integers(WIDTH)), int(rng.integers(HEIGHT))
        if rng.random() < 0.5:
            cv2.circle(image, (x, y), int(rng.integers(4, 60)), colour, -1, cv2.LINE_AA)
        else:
            cv2.fillPoly(image, [rng.integers(-40, 320, (3, 2)).astype(np.int32)], colour)
    return image


def text(rng: np.random.Generator) -> Image:
    """A page of dark letters on light paper, or the reverse."""
    paper, ink = (245, 20) if rng.random() < 0.7 else (20, 235)
    image = np.full((HEIGHT, WIDTH, 3), paper, np.uint8)
    for line in range(14, HEIGHT, 15):
        letters = "".join(chr(c) for c in rng.integers(97, 123, 36).tolist())
        cv2.putText(image, letters, (6, line), cv2.FONT_HERSHEY_SIMPLEX, 0.4, (ink,) * 3, 1)
    return image


def interior(rng: np.random.Generator) -> Image:
    """An image similar to a photograph of a room: smooth walls, boxes with shaded sides."""
    image = gradient(rng) // 2 + clouds(rng) // 6
    for _ in range(rng.integers(3, 9)):
        x, y = rng.integers(0, WIDTH - 30), rng.integers(40, HEIGHT - 20)
        width, height = rng.integers(20, 110), rng.integers(20, 120)
        shade = np.linspace(0.6, 1.0, image[y : y + height, x : x + width].shape[1])[None, :, None]
        image[y : y + height, x : x + width] = (shade * rng.integers(30, 230, 3)).astype(np.uint8)
    return cv2.GaussianBlur(image, (3, 3), 0).astype(np.uint8)


def seen_by(
    image: Image, camera: CameraParameters, fov_y_deg: float, pitch_deg: float = 0.0
) -> Image:
    """The image of a camera with another field of view and pitch (positive downwards) at the same
    place. Exact where `image` shows the scene; the border is replicated beyond it."""
    inside, outside = (_intrinsics(camera, fov) for fov in (camera.fov_y_deg, fov_y_deg))
    down = np.radians(pitch_deg)
    cosine, sine = np.cos(down), np.sin(down)
    rotation = np.array([[1, 0, 0], [0, cosine, -sine], [0, sine, cosine]])
    size = (camera.width, camera.height)
    warp = outside @ rotation @ np.linalg.inv(inside)
    return cv2.warpPerspective(image, warp, size, borderMode=cv2.BORDER_REPLICATE).astype(np.uint8)


def _intrinsics(camera: CameraParameters, fov_y_deg: float) -> NDArray[np.float64]:
    focal = camera.height / 2 / np.tan(np.radians(fov_y_deg) / 2)
    return np.array([[focal, 0, camera.width / 2], [0, focal, camera.height / 2], [0, 0, 1]])


def _full_range(values: NDArray[np.float64]) -> Image:
    low, high = values.min(), values.max()
    image: Image = ((values - low) / max(high - low, 1e-9) * 255).astype(np.uint8)
    return image
