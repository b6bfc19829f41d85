"""Light and exposure of one scene, beyond its kind of light. The defaults change nothing."""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Lighting:
    """Light and exposure of one scene, beyond its kind; see ranges.toml, section [light]."""

    exposure_stops: float = 0.0
    """Stops by which the picture is overexposed."""
    adaptation_stops: float = 0.0
    """Stops by which the exposure has opened at the end of a bridge's shadow."""
    low_sun_deg: float = 0.0
    """Elevation of a low sun; 0: the elevation of the kind of light."""
    flare: float = 0.0
    """Strength of the sun's glare in the lens."""
    night: bool = False
    lamp_every_m: float = 0.0
    """Distance between lit street lamps by night; 0: no lamps."""
    lamp_warmth: float = 0.5
    """Colour of lamps, 0 white to 1 sodium."""
    headlights: float = 1.0
    """Brightness of the car's headlights by night."""
