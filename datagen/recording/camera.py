"""The camera a round was recorded with: a model only understands images of the same one."""

from dataclasses import asdict, dataclass
from math import radians, tan

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, slots=True)
class CameraInfo:
    """Size in px, vertical field of view, place in m from the centre of gravity (x ahead, z up)."""

    width: int = 280
    height: int = 210
    fov_y_deg: float = 67.5
    x: float = 0.75
    y: float = 0.0
    z: float = 0.95
    pitch_deg: float = 0.0

    @property
    def intrinsics(self) -> NDArray[np.float64]:
        """Pinhole matrix K, (3, 3): square pixels, principal point in the middle."""
        focal = self.height / (2.0 * tan(radians(self.fov_y_deg) / 2.0))
        return np.array(
            [[focal, 0.0, self.width / 2.0], [0.0, focal, self.height / 2.0], [0.0, 0.0, 1.0]]
        )

    def as_dict(self) -> dict[str, float]:
        return asdict(self)

    def __str__(self) -> str:
        return (
            f"{self.width}x{self.height}, {self.fov_y_deg:g} deg, at ({self.x:g}, {self.y:g}, "
            f"{self.z:g}) m, pitch {self.pitch_deg:g} deg"
        )
