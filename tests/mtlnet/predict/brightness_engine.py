"""An engine that answers the brightness of an image, and images and films of given brightness."""

from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np
import simplejpeg
from numpy.typing import NDArray

from mtlnet.inference.model_card import ModelCard


@dataclass
class BrightnessEngine:
    """Answers the mean colour of an image as the coded angle."""

    card: ModelCard
    kind: str = "openvino"
    precision: str = "f32"
    seen: list[tuple[int, ...]] = field(default_factory=list)

    def __call__(self, image: NDArray[np.uint8]) -> NDArray[np.float32]:
        self.seen.append(image.shape)
        level = 0.1 + 0.8 * float(image.mean()) / 255
        return np.array([0.5, 0.5, 0.5, 0.5, 0.5, level, 0.1, 0.7, 0.2], np.float32)


def write_jpeg(path: Path, level: int, size: tuple[int, int] = (210, 280)) -> Path:
    path.write_bytes(simplejpeg.encode_jpeg(np.full((*size, 3), level, np.uint8), quality=95))
    return path


def write_film(path: Path, levels: list[int]) -> Path:
    film = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), 10.0, (560, 420))
    for level in levels:
        film.write(np.full((420, 560, 3), level, np.uint8))
    film.release()
    return path
