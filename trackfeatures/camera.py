"""The driver camera: size in pixels, lens, and mounting place in the body frame (SI units).

Body frame: x ahead, y left, z up, origin at the car's centre of gravity. Image frame: u right,
v down, square pixels, principal point in the middle.
"""

from dataclasses import asdict, dataclass
from math import radians, tan
from typing import TYPE_CHECKING, Any, ClassVar

from trackfeatures.errors import UserError

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

FOV_LIMITS_DEG = (1.0, 150.0)


class CameraError(UserError, ValueError):
    """Impossible camera parameters; also a ValueError, for readers of damaged files."""


@dataclass(frozen=True, slots=True)
class CameraParameters:
    """A pinhole camera on the car. A model understands only images of the camera it was trained
    with.

    Raises CameraError for a vertical field of view outside `FOV_LIMITS_DEG`.
    """

    width: int = 280
    height: int = 210
    fov_y_deg: float = 67.5
    x: float = 0.75
    y: float = 0.0
    z: float = 0.95
    pitch_deg: float = 0.0
    """Positive looks down."""

    cg_height_m: ClassVar[float] = 0.25
    """Height of the car's centre of gravity above the road."""

    def __post_init__(self) -> None:
        lo, hi = FOV_LIMITS_DEG
        if not lo <= self.fov_y_deg <= hi:
            raise CameraError(
                f"vertical field of view {self.fov_y_deg} deg; give one between {lo:g} and "
                f"{hi:g} deg"
            )

    @property
    def focal_px(self) -> float:
        """Focal length in pixels, the same for both image axes."""
        return self.height / 2 / tan(radians(self.fov_y_deg) / 2)

    @property
    def height_above_road_m(self) -> float:
        """Of the camera, on a car that stands level."""
        return self.z + self.cg_height_m

    def intrinsics(self) -> "NDArray[np.float64]":
        """Pinhole matrix K (3, 3) in pixels, measured from the image's top left corner."""
        import numpy as np  # a command's help needs no numpy

        focal = self.focal_px
        return np.array([[focal, 0.0, self.width / 2], [0.0, focal, self.height / 2], [0, 0, 1]])

    def as_dict(self) -> dict[str, Any]:
        """The fields by name, as they are written to files."""
        return asdict(self)

    def __str__(self) -> str:
        return (
            f"{self.width}x{self.height}, {self.fov_y_deg:g} deg, at ({self.x:g}, {self.y:g}, "
            f"{self.z:g}) m, pitch {self.pitch_deg:g} deg"
        )
