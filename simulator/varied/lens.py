"""Effects of lens and sensor on the pictures of one scene. The defaults change nothing."""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Lens:
    """Effects of lens and sensor on the pictures of one scene; see ranges.toml, [lens]."""

    vignette: float = 0.0
    """Share of the light lost in the corners."""
    softness_px: float = 0.0
    """Standard deviation of the blur, for a picture 280 pixels wide."""
    sharpening: float = 0.0
    travel_m: float = 0.0
    """Distance that the car drives during the exposure."""
    noise: float = 0.0
    """Standard deviation of the noise in display values of 0 to 255, before the tone curve."""
    contrast: float = 0.0
    """Contrast of the tone curve, beyond the contrast that displays expect."""
    red_gain: float = 1.0
    blue_gain: float = 1.0
    jpeg_quality: int = 0
    """Quality of the camera's JPEG compression; 0: no compression."""
