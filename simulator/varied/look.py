"""The random values of one scene of `--roads varied`; a scene of `--roads paper` has no look."""

from dataclasses import asdict, dataclass, field
from typing import Any

from simulator.varied.cabin import Cabin
from simulator.varied.draw import drawn_as, generator, rebuilt
from simulator.varied.lens import Lens
from simulator.varied.lighting import Lighting
from simulator.varied.paint import Paint
from simulator.varied.roadside import Roadside
from simulator.varied.surface import Surface


@dataclass(frozen=True, slots=True)
class RoadLook:
    """The look of one scene. The defaults of every part leave the picture unchanged."""

    paint: Paint = field(default_factory=Paint)
    surface: Surface = field(default_factory=Surface)
    roadside: Roadside = field(default_factory=Roadside)
    light: Lighting = field(default_factory=Lighting)
    lens: Lens = field(default_factory=Lens)
    cabin: Cabin = field(default_factory=Cabin)

    @staticmethod
    def drawn(seed: int, scene: int = 0) -> "RoadLook":
        """The look of scene number `scene` of the round with `seed`."""
        return RoadLook(
            paint=drawn_as(Paint, "paint", generator(seed, "paint", scene)),
            surface=drawn_as(Surface, "surface", generator(seed, "surface", scene)),
            roadside=drawn_as(Roadside, "roadside", generator(seed, "roadside", scene)),
            light=drawn_as(Lighting, "light", generator(seed, "light", scene)),
            lens=drawn_as(Lens, "lens", generator(seed, "lens", scene)),
            cabin=drawn_as(Cabin, "cabin", generator(seed, "cabin", scene)),
        )

    def as_dict(self) -> dict[str, Any]:
        """The values by name, as they are written to files."""
        return asdict(self)

    @staticmethod
    def from_dict(values: dict[str, Any]) -> "RoadLook":
        """The look with these values; raises KeyError, TypeError or ValueError for other values."""
        look: RoadLook = rebuilt(RoadLook, values)
        return look
