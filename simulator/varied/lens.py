"""What the lens and the sensor do to the pictures of one scene. Defaults are today's pictures."""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Lens:
    """What the lens and the sensor do to the pictures of one scene; see ranges.toml, [lens]."""

    vignette: float = 0.0
    """Share of the light lost in the corners."""
    softness_px: float = 0.0
    """Standard deviation of the blur, for a picture 280 pixels wide."""
    sharpening: float = 0.0
    travel_m: float = 0.0
    """How far the car moves during the exposure."""
    noise: float = 0.0
    """Standard deviation in display values of 0 to 255, before the tone curve."""
    contrast: float = 0.0
    """Of the tone curve, beyond the one displays expect."""
    red_gain: float = 1.0
    blue_gain: float = 1.0
    jpeg_quality: int = 0
    """Of the camera's own compression; 0: none."""
