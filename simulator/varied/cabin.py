"""What of the car the camera sees in one scene. Defaults are today's pictures."""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Cabin:
    """What of the car the camera sees in one scene; see ranges.toml, section [cabin]."""

    bonnet: float = 0.0
    """Share of the picture's rows that its highest point covers; 0: out of sight."""
    reflection: float = 0.0
    """Share of a bright dashboard's light that the windscreen mirrors."""
    dirt: float = 0.0
    """Of the windscreen, 0 to 1."""
    drops: float = 0.0
    """Share of the windscreen that rain drops cover before the wiper comes."""
    wipers: bool = False
    shape: int = 0
    """Seed of the shapes: of the bonnet, dirt, reflections and drops."""
