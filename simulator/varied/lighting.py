"""Light and exposure of one scene, beyond its kind of light. Defaults are today's pictures."""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Lighting:
    """Light and exposure of one scene, beyond its kind; see ranges.toml, section [light]."""

    exposure_stops: float = 0.0
    """By how much the picture is too bright."""
    adaptation_stops: float = 0.0
    """By how much the exposure has opened at the end of a bridge's shadow."""
    low_sun_deg: float = 0.0
    """Height of a low sun; 0: the sun of the kind of light."""
    flare: float = 0.0
    """Strength of the sun's glare in the lens."""
    night: bool = False
    lamp_every_m: float = 0.0
    """Distance of the lit street lamps by night; 0: none."""
    lamp_warmth: float = 0.5
    """Colour of lamps, 0 white to 1 sodium."""
    headlights: float = 1.0
    """Brightness of the car's headlights by night."""
