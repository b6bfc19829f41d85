"""Light and weather: direction of the sun, brightness of sun and sky, visibility.

Colours are linear RGB. Azimuth is in rad counter-clockwise from world x, elevation in rad.
light.toml contains the values of each kind of light.
"""

import math
import tomllib
from dataclasses import dataclass, fields
from functools import cache
from importlib.resources import files

import numpy as np

from simulator.varied.draw import Tables, draw
from trackfeatures.errors import UserError

Colour = tuple[float, float, float]

KINDS: tuple[str, ...] = ("clear", "overcast", "dusk", "fog", "heavy-shadow", "rain", "snow")
WEATHERS: tuple[str, ...] = ("rain", "snow")
"""The kinds of light with rain or snow; all other kinds are dry."""


@dataclass(frozen=True)
class Light:
    """The light and weather of one scene."""

    kind: str
    sun_azimuth: float
    sun_elevation: float
    sun: Colour
    """Light that the sun gives a surface facing it."""
    sky: Colour
    """Light that the sky gives a horizontal surface."""
    zenith: Colour
    horizon: Colour
    haze: Colour
    haze_per_km: float
    """Extinction: after 1 km the share exp(-haze_per_km) of an object's colour is left."""
    clouds: float
    """Share of the sky that clouds cover, 0 to 1."""
    shade: float
    """Share of the lit luminance that is left in a hard shadow on the road, 0 to 1."""
    canopy: bool = False
    """Whether trees meet over the road and cast dappled shadow on it (only kind "heavy-shadow")."""
    exposure: float = 1.0
    cover: float = 0.0
    """Wetness of the road in rain, or share of the road that is white in snow; 0 to 1."""
    falling: float = 0.0
    """Density of rain or snow, 0 to 1."""

    @property
    def weather(self) -> str:
        """The kind of light if it is "rain" or "snow", else ""."""
        return self.kind if self.kind in WEATHERS else ""

    @staticmethod
    def named(kind: str, rng: np.random.Generator) -> "Light":
        """Make a light of `kind` with random parameters from `rng`. Raises UserError for an unknown
        kind."""
        check_light(kind)
        drawn = draw(_tables(), kind, rng)
        elevation = drawn["sun_elevation"] = math.radians(drawn["sun_elevation_deg"])
        if isinstance(drawn["sun"], list):
            drawn["sun"] = _tinted_sun(kind, drawn["sun"], drawn["sun_strength"], elevation)
        known = {field.name: drawn[field.name] for field in fields(Light) if field.name in drawn}
        return Light(kind, **known, exposure=float(np.exp(rng.uniform(-0.16, 0.16))))

    @property
    def sun_direction(self) -> tuple[float, float, float]:
        """Unit vector (x, y, z) towards the sun, world."""
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


@cache
def _tables() -> Tables:
    """Return the tables of light.toml by kind; that file explains the entries."""
    text = files("simulator.camera.scene").joinpath("light.toml").read_text(encoding="utf-8")
    return tomllib.loads(text)


def _tinted_sun(kind: str, colour: list[float], strength: float, elevation: float) -> Colour:
    """Return the sun's colour in clear air: `colour`, linear RGB, times `strength`, and redder at a
    low `elevation` (rad). At dusk, red and green are multiplied by `strength` and blue is not
    changed."""
    red, green, blue = colour
    if kind == "dusk":
        return red * strength, green * strength, blue
    warm = 1.0 - 0.25 * math.cos(elevation) ** 2
    return red * strength, green * strength * (0.5 + 0.5 * warm), blue * strength * warm
