"""Applies the look of a varied road to a light: exposure, a low sun, or night with headlights."""

import math
from dataclasses import replace

from simulator.camera.scene.light import Colour, Light
from simulator.varied.look import Lighting

SUNNY = ("clear", "dusk", "heavy-shadow")
"""Kinds of light in which a look may lower the sun."""
USUAL_ALBEDO, COMPENSATED = 0.13, 0.45
"""Albedo of the road for which the lights are exposed; exponent of the automatic exposure."""
DARKEST_NIGHT_STOPS = -0.5
"""Least exposure of a night picture in stops. Darker pictures would be black."""
HEADLIGHT: Colour = (3.4, 3.2, 2.75)
_NIGHT_SKY: Colour = (0.006, 0.007, 0.010)
_GLOW: Colour = (0.010, 0.009, 0.010)
_SODIUM: Colour = (1.0, 0.62, 0.25)
_WHITE: Colour = (0.92, 0.97, 1.0)
LAMP_GLOW = 0.035
"""Scattered light on a lit road, as a share of the light directly below a lamp."""


def lit_as(light: Light, look: Lighting, albedo: float = 0.0) -> Light:
    """Return `light` changed by `look`. Like a camera's automatic exposure, the exposure is
    multiplied by (0.13 / `albedo`)^0.45, with the `albedo` of the road; if `albedo` is 0, the road
    is as bright as the scenery defines it, and the exposure is not adapted."""
    automatic = (USUAL_ALBEDO / albedo) ** COMPENSATED if albedo else 1.0
    stops = look.exposure_stops
    if look.night:
        light, stops = _by_night(light, look), max(stops, DARKEST_NIGHT_STOPS)
    elif look.low_sun_deg > 0.0 and light.kind in SUNNY:
        light = _with_low_sun(light, look.low_sun_deg)
    return replace(light, exposure=light.exposure * automatic * 2.0**stops)


def lamp_colour(look: Lighting) -> Colour:
    """Return the light, linear RGB, of a street lamp on the road directly below it; black if no
    lamps are lit."""
    if not (look.night and look.lamp_every_m > 0.0):
        return 0.0, 0.0, 0.0
    red, green, blue = (
        0.55 * (white + look.lamp_warmth * (sodium - white))
        for white, sodium in zip(_WHITE, _SODIUM, strict=True)
    )
    return red, green, blue


def _by_night(light: Light, look: Lighting) -> Light:
    """Return `light` at night: only headlights, lamps and a glow over the horizon are left. The
    headlights replace the sun (see night.glsl), so the sun is put at the zenith, out of sight."""
    lamps = lamp_colour(look)

    def mixed(dark: Colour, share: float) -> Colour:
        red, green, blue = (d + share * lamp for d, lamp in zip(dark, lamps, strict=True))
        return red, green, blue

    red, green, blue = (look.headlights * part for part in HEADLIGHT)
    return replace(
        light,
        sun_azimuth=0.0,
        sun_elevation=math.pi / 2,
        sun=(red, green, blue),
        sky=mixed(_NIGHT_SKY, LAMP_GLOW),
        zenith=mixed((0.0015, 0.002, 0.004), 0.004),
        horizon=mixed(_GLOW, 0.03),
        haze=mixed((0.004, 0.004, 0.005), 0.02),
        clouds=0.0,
        shade=0.95,
        canopy=False,
    )


def _with_low_sun(light: Light, elevation_deg: float) -> Light:
    """Return `light` with the sun at `elevation_deg` (deg), where it is also redder and dimmer."""
    elevation = min(math.radians(elevation_deg), light.sun_elevation)
    clear = math.sin(elevation) / math.sin(max(light.sun_elevation, elevation))
    red, green, blue = light.sun
    warm: Colour = (red, green * (0.72 + 0.28 * clear), blue * (0.45 + 0.55 * clear))
    dim = 0.75 + 0.25 * clear
    hazy = [h * t for h, t in zip(light.horizon, (1.12, 1.0, 0.88), strict=True)]
    return replace(
        light,
        sun_elevation=elevation,
        sun=(warm[0] * dim, warm[1] * dim, warm[2] * dim),
        sky=(light.sky[0] * dim, light.sky[1] * dim, light.sky[2] * dim),
        horizon=(hazy[0], hazy[1], hazy[2]),
    )
