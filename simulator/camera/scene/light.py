"""Light and weather: direction of the sun, brightness of sun and sky, visibility.

Colours are linear RGB; azimuth in rad counter-clockwise from world x, elevation in rad.
"""

import math
from dataclasses import dataclass, replace

import numpy as np

from trackfeatures.errors import UserError

Colour = tuple[float, float, float]

KINDS: tuple[str, ...] = ("clear", "overcast", "dusk", "fog", "heavy-shadow", "rain", "snow")
WEATHERS: tuple[str, ...] = ("rain", "snow")
"""The kinds with precipitation; the others are dry."""


@dataclass(frozen=True)
class Light:
    """One light. `shade` is the share of the lit luminance left in a hard shadow on the road."""

    kind: str
    sun_azimuth: float
    sun_elevation: float
    sun: Colour
    """Light of the sun on a surface that faces it."""
    sky: Colour
    """Light from above on a level surface."""
    zenith: Colour
    horizon: Colour
    haze: Colour
    haze_per_km: float
    """Extinction: after 1 km exp(-haze_per_km) of a colour is left."""
    clouds: float
    """Share of the sky that is cloud, 0 to 1."""
    shade: float
    canopy: bool = False
    """Whether trees meet over the road and cast dappled shadow on it (kind "heavy-shadow")."""
    exposure: float = 1.0
    cover: float = 0.0
    """Rain: how wet the road is; snow: how much of it is white; 0 to 1."""
    falling: float = 0.0
    """Density of rain or snow, 0 to 1."""

    @property
    def weather(self) -> str:
        """One of WEATHERS, or "" when it is dry."""
        return self.kind if self.kind in WEATHERS else ""

    @staticmethod
    def named(kind: str, rng: np.random.Generator) -> "Light":
        """A light of `kind`, its random parameters drawn from `rng`. UserError if unknown."""
        check_light(kind)
        light = _SAMPLERS[kind](rng)
        return replace(light, exposure=float(np.exp(rng.uniform(-0.16, 0.16))))

    @property
    def sun_direction(self) -> tuple[float, float, float]:
        """Unit vector towards the sun."""
        level = math.cos(self.sun_elevation)
        return (
            level * math.cos(self.sun_azimuth),
            level * math.sin(self.sun_azimuth),
            math.sin(self.sun_elevation),
        )


def check_light(kind: str) -> None:
    """Raises UserError unless `kind` is one of KINDS."""
    if kind not in KINDS:
        raise UserError(f"unknown light '{kind}'; the lights are {', '.join(KINDS)}")


def _jitter(colour: Colour, rng: np.random.Generator, amount: float) -> Colour:
    red, green, blue = (float(c * (1.0 + rng.uniform(-amount, amount))) for c in colour)
    return red, green, blue


def _clear(rng: np.random.Generator) -> Light:
    elevation = math.radians(rng.uniform(24.0, 62.0))
    warm = 1.0 - 0.25 * math.cos(elevation) ** 2
    strength = rng.uniform(0.95, 1.2)
    return Light(
        "clear",
        sun_azimuth=rng.uniform(-math.pi, math.pi),
        sun_elevation=elevation,
        sun=(1.9 * strength, 1.8 * strength * (0.5 + 0.5 * warm), 1.62 * strength * warm),
        sky=_jitter((0.42, 0.48, 0.60), rng, 0.08),
        zenith=_jitter((0.10, 0.24, 0.62), rng, 0.15),
        horizon=_jitter((0.62, 0.74, 0.86), rng, 0.08),
        haze=_jitter((0.60, 0.70, 0.80), rng, 0.08),
        haze_per_km=rng.uniform(0.25, 1.1),
        clouds=rng.uniform(0.0, 0.55),
        shade=0.0,
    )


def _overcast(rng: np.random.Generator) -> Light:
    grey = rng.uniform(0.75, 1.1)
    return Light(
        "overcast",
        sun_azimuth=rng.uniform(-math.pi, math.pi),
        sun_elevation=math.radians(55.0),
        sun=(0.16 * grey, 0.16 * grey, 0.16 * grey),
        sky=_jitter((1.25 * grey, 1.28 * grey, 1.34 * grey), rng, 0.04),
        zenith=_jitter((0.42 * grey, 0.45 * grey, 0.50 * grey), rng, 0.06),
        horizon=_jitter((0.62 * grey, 0.64 * grey, 0.67 * grey), rng, 0.05),
        haze=_jitter((0.58 * grey, 0.60 * grey, 0.63 * grey), rng, 0.05),
        haze_per_km=rng.uniform(0.8, 2.5),
        clouds=1.0,
        shade=0.85,
    )


def _dusk(rng: np.random.Generator) -> Light:
    warm = rng.uniform(0.8, 1.2)
    return Light(
        "dusk",
        sun_azimuth=rng.uniform(-math.pi, math.pi),
        sun_elevation=math.radians(rng.uniform(7.0, 14.0)),
        sun=(1.35 * warm, 0.72 * warm, 0.36),
        sky=_jitter((0.34, 0.33, 0.42), rng, 0.1),
        zenith=_jitter((0.13, 0.18, 0.36), rng, 0.15),
        horizon=_jitter((0.85, 0.52, 0.33), rng, 0.12),
        haze=_jitter((0.55, 0.43, 0.38), rng, 0.1),
        haze_per_km=rng.uniform(0.8, 2.0),
        clouds=rng.uniform(0.2, 0.7),
        shade=0.3,
    )


def _fog(rng: np.random.Generator) -> Light:
    grey = rng.uniform(0.75, 1.05)
    air = _jitter((0.62 * grey, 0.64 * grey, 0.66 * grey), rng, 0.05)
    return Light(
        "fog",
        sun_azimuth=rng.uniform(-math.pi, math.pi),
        sun_elevation=math.radians(50.0),
        sun=(0.05, 0.05, 0.05),
        sky=_jitter((1.0 * grey, 1.02 * grey, 1.05 * grey), rng, 0.04),
        zenith=air,
        horizon=air,
        haze=air,
        haze_per_km=rng.uniform(7.0, 16.0),
        clouds=0.0,
        shade=0.9,
    )


def _heavy_shadow(rng: np.random.Generator) -> Light:
    light = _clear(rng)
    return replace(
        light,
        kind="heavy-shadow",
        sun_elevation=math.radians(rng.uniform(42.0, 62.0)),
        sun=(2.25, 2.15, 1.9),
        sky=_jitter((0.20, 0.225, 0.275), rng, 0.05),
        clouds=rng.uniform(0.0, 0.3),
        canopy=True,
    )


def _rain(rng: np.random.Generator) -> Light:
    grey = rng.uniform(0.52, 0.85)
    heavy = rng.uniform(0.0, 1.0)
    air = _jitter((0.50 * grey, 0.525 * grey, 0.56 * grey), rng, 0.04)
    return Light(
        "rain",
        sun_azimuth=rng.uniform(-math.pi, math.pi),
        sun_elevation=math.radians(rng.uniform(35.0, 60.0)),
        sun=(0.05 * grey, 0.05 * grey, 0.05 * grey),
        sky=_jitter((1.05 * grey, 1.10 * grey, 1.18 * grey), rng, 0.04),
        zenith=_jitter((0.34 * grey, 0.37 * grey, 0.42 * grey), rng, 0.06),
        horizon=_jitter((0.56 * grey, 0.58 * grey, 0.61 * grey), rng, 0.05),
        haze=air,
        haze_per_km=2.0 + 6.0 * heavy,
        clouds=1.0,
        shade=0.95,
        cover=rng.uniform(0.55, 1.0),
        falling=0.35 + 0.65 * heavy,
    )


def _snow(rng: np.random.Generator) -> Light:
    grey = rng.uniform(0.72, 1.0)
    heavy = rng.uniform(0.0, 1.0)
    air = _jitter((0.60 * grey, 0.62 * grey, 0.65 * grey), rng, 0.03)
    return Light(
        "snow",
        sun_azimuth=rng.uniform(-math.pi, math.pi),
        sun_elevation=math.radians(rng.uniform(25.0, 50.0)),
        sun=(0.10 * grey, 0.10 * grey, 0.095 * grey),
        sky=_jitter((0.80 * grey, 0.83 * grey, 0.88 * grey), rng, 0.03),
        zenith=_jitter((0.50 * grey, 0.52 * grey, 0.56 * grey), rng, 0.04),
        horizon=air,
        haze=air,
        haze_per_km=2.5 + 7.0 * heavy,
        clouds=rng.uniform(0.6, 1.0),
        shade=0.9,
        cover=rng.uniform(0.2, 0.75),
        falling=0.3 + 0.7 * heavy,
    )


_SAMPLERS = {
    "clear": _clear,
    "overcast": _overcast,
    "dusk": _dusk,
    "fog": _fog,
    "heavy-shadow": _heavy_shadow,
    "rain": _rain,
    "snow": _snow,
}
