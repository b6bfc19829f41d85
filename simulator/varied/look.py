"""The random values of one scene of `--roads varied`; scenes of `--roads paper` have no look.

The default values of all parts leave the picture as the track's scenery defines it.
"""

from dataclasses import asdict, dataclass, field
from typing import Any, Literal

from simulator.varied.draw import drawn_as, generator, rebuilt

ArrowKind = Literal["ahead", "left", "right"]


@dataclass(frozen=True, slots=True)
class Paint:
    """The paint of one scene; the section [paint] of ranges.toml explains the values."""

    tone: float = 1.0
    wear: float = 0.0
    missing: float = 0.0
    gap_m: float = 0.0
    gap_every_m: float = 60.0
    gap_marking: int = 9
    arrow_every_m: float = 0.0
    arrow_kind: ArrowKind = "ahead"
    crosswalk_every_m: float = 0.0
    phase: float = 0.0


@dataclass(frozen=True, slots=True)
class Surface:
    """The road's surface in one scene; see ranges.toml, section [surface]."""

    tone: float = 0.0
    """Albedo of the asphalt; 0: the albedo of the track's scenery."""
    warmth: float = 0.0
    """Excess of red over blue in the asphalt's colour, as a share."""
    other_tone: float = 0.0
    """Albedo of a second material, whose sections alternate with sections of the first material; 0:
    there is no second material."""
    section_m: float = 100.0
    """Mean length of the sections of both materials, m."""
    concrete: float = 0.0
    """Sections made of concrete slabs: 0: none, 1: the sections of both materials, -1: the sections
    of the second material."""
    joint_m: float = 5.0
    """Distance (m) between the joints of concrete slabs."""
    halves: float = 0.0
    """Difference in tone between the two sides of a lengthwise seam, as a share."""
    seam_m: float = 0.0
    """Lateral position of the seam, m left of the road's centre."""
    tar: float = 0.0
    """Share of the seams and cracks that are filled with tar, 0 to 1."""
    patches: float = 0.0
    """Share of the surface that is covered with patches of another tone."""
    patch_tone: float = 0.7
    tracks: float = 0.14
    """Share by which wheels have darkened the surface; negative: brightened."""
    grain: float = 1.0
    puddles: float = 0.0
    """Share of the surface under water."""
    ragged_m: float = 0.0
    """Largest deviation of the asphalt's edge from a straight line."""
    gravel_m: float = 0.0
    """Width of a strip of gravel beside the asphalt."""
    kerb_m: float = 0.0
    """Width of kerb stones beside the asphalt; 0: no kerb stones."""
    phase: float = 0.0


@dataclass(frozen=True, slots=True)
class Roadside:
    """Objects close to the road in one scene; see ranges.toml, section [roadside]."""

    gap_m: float = -1.0
    """Least distance from the asphalt to the drawn barriers; negative: the barriers are drawn where
    cars hit them."""
    left: str = ""
    """Kind of the barrier on the left of the road (see `camera.scene.barriers`). "": the kinds
    change by section, as in the track's scenery."""
    right: str = ""
    height: float = 1.0
    """Factor on the height of walls, crops and snow banks."""
    trees: float = 1.0
    """Factor on the number of trees."""
    tunnel: bool = False
    """Whether dense rows of trees stand behind the barriers, their crowns closed over the road."""
    parked_every_m: float = 0.0
    """Mean distance between cars parked beside the asphalt; 0: no cars."""
    bridge_every_m: float = 0.0
    """Distance between bridges over the road; 0: the distance in the track's scenery."""
    dry: float = 0.0
    """Share of the grass that is yellow, in addition to the yellow grass of the track's scenery."""


@dataclass(frozen=True, slots=True)
class Lighting:
    """Light and exposure of one scene; see ranges.toml, section [light]."""

    exposure_stops: float = 0.0
    """Stops by which the picture is overexposed."""
    adaptation_stops: float = 0.0
    """Stops by which the exposure has increased at the end of a bridge's shadow."""
    low_sun_deg: float = 0.0
    """Elevation (deg) of a low sun; 0: the elevation of the kind of light."""
    flare: float = 0.0
    """Strength of the sun's glare in the lens."""
    night: bool = False
    lamp_every_m: float = 0.0
    """Distance between lit street lamps at night; 0: no lamps."""
    lamp_warmth: float = 0.5
    """Colour of the lamps, from 0 (white) to 1 (sodium)."""
    headlights: float = 1.0
    """Brightness of the car's headlights at night, as a factor."""


@dataclass(frozen=True, slots=True)
class Lens:
    """Effects of lens and sensor on the pictures of one scene; see ranges.toml, section [lens]."""

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
    """Additional slope in the middle of the tone curve; 0: a linear curve."""
    red_gain: float = 1.0
    blue_gain: float = 1.0
    jpeg_quality: int = 0
    """Quality of the camera's JPEG compression; 0: no compression."""


@dataclass(frozen=True, slots=True)
class Cabin:
    """Parts of the car that the camera sees in one scene; see ranges.toml, section [cabin]."""

    bonnet: float = 0.0
    """Share of the picture's rows that the bonnet's highest point covers; 0: not visible."""
    reflection: float = 0.0
    """Share of a bright dashboard's light that the windscreen reflects."""
    dirt: float = 0.0
    """Amount of dirt on the windscreen, 0 to 1."""
    drops: float = 0.0
    """Share of the windscreen that rain drops cover just before a stroke of the wiper."""
    wipers: bool = False
    shape: int = 0
    """Seed of the shapes of bonnet, dirt, reflections and drops."""


@dataclass(frozen=True, slots=True)
class RoadLook:
    """The look of one scene. The default values of all parts leave the picture unchanged."""

    paint: Paint = field(default_factory=Paint)
    surface: Surface = field(default_factory=Surface)
    roadside: Roadside = field(default_factory=Roadside)
    light: Lighting = field(default_factory=Lighting)
    lens: Lens = field(default_factory=Lens)
    cabin: Cabin = field(default_factory=Cabin)

    @staticmethod
    def drawn(seed: int, scene: int = 0) -> "RoadLook":
        """Return the random look of scene number `scene` of the round with `seed`."""
        return RoadLook(
            paint=drawn_as(Paint, "paint", generator(seed, "paint", scene)),
            surface=drawn_as(Surface, "surface", generator(seed, "surface", scene)),
            roadside=drawn_as(Roadside, "roadside", generator(seed, "roadside", scene)),
            light=drawn_as(Lighting, "light", generator(seed, "light", scene)),
            lens=drawn_as(Lens, "lens", generator(seed, "lens", scene)),
            cabin=drawn_as(Cabin, "cabin", generator(seed, "cabin", scene)),
        )

    def as_dict(self) -> dict[str, Any]:
        """Return the values by name, as they are written to files."""
        return asdict(self)

    @staticmethod
    def from_dict(values: dict[str, Any]) -> "RoadLook":
        """Return the look whose `as_dict` is `values`. Raises KeyError, TypeError or ValueError if
        a field is unknown or has another structure."""
        look: RoadLook = rebuilt(RoadLook, values)
        return look
