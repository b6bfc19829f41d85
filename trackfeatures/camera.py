"""The driver camera: size in px, lens, and mount (position and angles) in the body frame.

Body frame: x ahead, y left, z up, origin at the car's centre of gravity. Camera frame: x right,
y down, z ahead along the optical axis. Image frame: pixels, u right, v down; a pixel's centre has
whole coordinates, so a centred principal point is ((width - 1) / 2, (height - 1) / 2).
"""

from dataclasses import asdict, dataclass, fields, replace
from math import atan, degrees, isfinite, radians, tan
from numbers import Integral, Real
from typing import TYPE_CHECKING, Any, ClassVar

from trackfeatures.errors import UserError

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import ArrayLike, NDArray

FOV_LIMITS_DEG = (1.0, 150.0)
COEFFICIENTS: dict[str, tuple[int, ...]] = {"none": (0,), "opencv": (4, 5, 8), "fisheye": (4,)}
"""Distortion models, each with the numbers of coefficients that it accepts."""


class CameraError(UserError, ValueError):
    """Raised for impossible camera parameters. It is also a ValueError, because the code that reads
    files catches ValueErrors."""


@dataclass(frozen=True, slots=True)
class CameraParameters:
    """A camera on the car: size in px, lens, and mount in m and degrees. A model is valid only for
    images of its training camera, or images warped to that camera's view.

    The camera's rotation relative to the car is Rz(yaw) Ry(pitch) Rx(roll). Raises CameraError for
    an impossible lens, for example a vertical field of view outside 1 to 150 deg.
    """

    width: int = 280
    height: int = 210
    fov_y_deg: float = 67.5
    """Vertical field of view without distortion; computed from `matrix` if `matrix` is given."""
    x: float = 0.75
    y: float = 0.0
    z: float = 0.95
    pitch_deg: float = 0.0
    """Pitch, deg; positive: the camera looks down."""
    roll_deg: float = 0.0
    """Roll, deg; positive: the right side is lowered."""
    yaw_deg: float = 0.0
    """Yaw, deg; positive: the camera is turned to the left."""
    matrix: tuple[float, float, float, float] | None = None
    """fx, fy, cx, cy in px. None: square pixels, `fov_y_deg`, principal point in the centre."""
    distortion: str = "none"
    """Distortion model; it determines the meaning of `coefficients`. "none": none; "opencv": k1,
    k2, p1, p2 [, k3 [, k4, k5, k6]]; "fisheye": k1 to k4."""
    coefficients: tuple[float, ...] = ()
    height_std: float = 0.0
    """Standard deviation of the height above the road, as a fraction of that height."""

    cg_height_m: ClassVar[float] = 0.25
    """Height of the car's centre of gravity above the road, m."""

    def __post_init__(self) -> None:
        for name in ("width", "height"):
            pixels = getattr(self, name)
            if not isinstance(pixels, Integral) or pixels < 0:
                raise CameraError(f"the {name} of a camera is {pixels!r}; give whole px")
        for name in ("x", "y", "z", "pitch_deg", "roll_deg", "yaw_deg"):
            value = getattr(self, name)
            if not isinstance(value, Real) or not isfinite(value):
                raise CameraError(f"{name} is {value!r}, so the camera is impossible")
        if self.matrix is not None:
            matrix = _numbers("matrix", self.matrix, (4,))
            if min(matrix[:2]) <= 0:
                raise CameraError(
                    f"the focal lengths {matrix[0]:g} and {matrix[1]:g} px of a camera must be "
                    "above 0: its matrix is singular"
                )
            object.__setattr__(self, "matrix", matrix)
            fov_y_deg = degrees(2 * atan(self.height / 2 / matrix[1]))
            object.__setattr__(self, "fov_y_deg", fov_y_deg)
        if self.distortion not in tuple(COEFFICIENTS):  # may be unhashable
            kinds = ", ".join(COEFFICIENTS)
            raise CameraError(f"the distortion is {self.distortion!r}; give one of {kinds}")
        counts = COEFFICIENTS[self.distortion]
        coefficients = _numbers(f"{self.distortion} distortion", self.coefficients, counts)
        object.__setattr__(self, "coefficients", coefficients)
        lo, hi = FOV_LIMITS_DEG
        if not isinstance(self.fov_y_deg, Real) or not lo <= self.fov_y_deg <= hi:
            raise CameraError(
                f"vertical field of view {self.fov_y_deg} deg; give a value between {lo:g} and "
                f"{hi:g} deg"
            )
        if not 0.0 <= self.height_std < 1.0:
            raise CameraError(
                f"height_std is {self.height_std}; give a fraction of the height, at least 0 and "
                "below 1"
            )

    @property
    def focal_px(self) -> float:
        """Vertical focal length fy in px; without a `matrix` fx has the same value."""
        if self.matrix is not None:
            return self.matrix[1]
        return self.height / 2 / tan(radians(self.fov_y_deg) / 2)

    @property
    def height_above_road_m(self) -> float:
        """Height of the camera above the road in m when the car is level."""
        return self.z + self.cg_height_m

    @property
    def is_plain(self) -> bool:
        """Whether the camera is a centred pinhole with square pixels, roll 0 and yaw 0. The horizon
        of a level road is then one row of pixels."""
        return (
            self.matrix is None
            and self.distortion == "none"
            and self.roll_deg == 0.0
            and self.yaw_deg == 0.0
        )

    def intrinsics(self) -> "NDArray[np.float64]":
        """Return the pinhole matrix K (3, 3) in px."""
        import numpy as np  # imported here: `--help` of a command must not load numpy

        focal = self.focal_px
        centre = ((self.width - 1) / 2, (self.height - 1) / 2)
        fx, fy, cx, cy = self.matrix or (focal, focal, *centre)
        return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])

    def rotation(self) -> "NDArray[np.float64]":
        """Return the rotation matrix (3, 3) from the car's frame to the camera's frame."""
        from trackfeatures.lens import mount_rotation

        return mount_rotation(
            radians(self.roll_deg), radians(self.pitch_deg), radians(self.yaw_deg)
        )

    def project(self, points: "ArrayLike") -> "NDArray[np.float64]":
        """Project points (N, 3) in m in the car's frame to pixels (N, 2). Pixels are NaN for points
        behind the camera and for points at larger angles from the axis than the lens model covers
        (see `lens`)."""
        import numpy as np

        from trackfeatures.lens import project

        away = np.asarray(points, dtype=np.float64).reshape(-1, 3) - (self.x, self.y, self.z)
        return project(self, away @ self.rotation().T)

    def rays(self, pixels: "ArrayLike") -> "NDArray[np.float64]":
        """Return the ray directions (N, 3), with z = 1, of pixels (N, 2) in the camera's frame. The
        direction is NaN for a pixel to which the lens model maps no ray."""
        from trackfeatures.lens import rays

        return rays(self, pixels)

    def road_points(self, pixels: "ArrayLike") -> "NDArray[np.float64]":
        """Return the points (N, 2) in m on a flat road that pixels (N, 2) show: x ahead and y left
        of the point below the centre of gravity. Points are NaN for pixels on or above the
        horizon."""
        import numpy as np

        ahead, left, up = (self.rays(pixels) @ self.rotation()).T
        with np.errstate(divide="ignore", invalid="ignore"):
            far = np.where(up < 0, -self.height_above_road_m / up, np.nan)
        return np.column_stack([self.x + far * ahead, self.y + far * left])

    def homography(self, other: "CameraParameters") -> "NDArray[np.float64]":
        """Return the homography (3, 3) from pixels of this camera to pixels of the camera `other`.
        It is exact if both cameras have the same position and no distortion (Hartley and Zisserman
        2004, 8.4)."""
        import numpy as np

        turn = other.rotation() @ self.rotation().T
        found: NDArray[np.float64] = other.intrinsics() @ turn @ np.linalg.inv(self.intrinsics())
        return found

    def undistorted(self) -> "CameraParameters":
        """Return the same camera with a lens without distortion."""
        return replace(self, distortion="none", coefficients=())

    def resized(self, width: int, height: int) -> "CameraParameters":
        """Return the camera whose images are the images of this camera, scaled to `width` x
        `height` px. The aspect ratio may change."""
        if self.matrix is None and width * self.height == height * self.width:
            return replace(self, width=width, height=height)
        x, y = width / self.width, height / self.height
        k = self.intrinsics()
        centre = (k[0, 2] + 0.5) * x - 0.5, (k[1, 2] + 0.5) * y - 0.5
        matrix = (float(k[0, 0] * x), float(k[1, 1] * y), float(centre[0]), float(centre[1]))
        return replace(self, width=width, height=height, matrix=matrix)

    def as_dict(self) -> dict[str, Any]:
        """Return the fields by name as they are written to files. Fields that older files do not
        contain are omitted if they have their default value (see `stored`)."""
        return asdict(self, dict_factory=stored)

    def __str__(self) -> str:
        turned = "".join(
            f", {name} {angle:g} deg"
            for name, angle in (("roll", self.roll_deg), ("yaw", self.yaw_deg))
            if angle
        )
        lens = "" if self.distortion == "none" else f", {self.distortion} distortion"
        return (
            f"{self.width}x{self.height}, {self.fov_y_deg:g} deg, at ({self.x:g}, {self.y:g}, "
            f"{self.z:g}) m, pitch {self.pitch_deg:g} deg{turned}{lens}"
        )


_NAMES = tuple(field.name for field in fields(CameraParameters))
_LATER = {field.name: field.default for field in fields(CameraParameters)[7:]}
"""Fields that older files do not contain, with their defaults."""


def stored(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """Return `pairs` as a dict; use it as the `dict_factory` of `dataclasses.asdict`. In cameras,
    fields that older files do not contain (`_LATER`) are omitted if they have their default value,
    so that the hash of a camera from an older file stays the same."""
    values = dict(pairs)
    if tuple(values) == _NAMES:
        return {k: v for k, v in values.items() if k not in _LATER or v != _LATER[k]}
    return values


def _numbers(what: str, values: Any, counts: tuple[int, ...]) -> tuple[Any, ...]:
    """Return `values` as floats. Raises CameraError unless finite and of a number in `counts`."""
    listed = tuple(values) if isinstance(values, list | tuple) else None
    wanted = " or ".join(map(str, counts))
    if listed is None or len(listed) not in counts:
        seen = repr(values) if listed is None else f"{len(listed)} numbers"
        raise CameraError(f"the {what} of a camera has {seen}; give {wanted} numbers")
    for value in listed:
        if isinstance(value, bool) or not isinstance(value, int | float) or not isfinite(value):
            raise CameraError(f"the {what} of a camera holds {value!r}; give finite numbers")
    return tuple(map(float, listed))
