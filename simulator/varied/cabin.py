"""Parts of the car that the camera sees in one scene. The defaults add nothing to the picture."""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Cabin:
    """Parts of the car that the camera sees in one scene; see ranges.toml, section [cabin]."""

    bonnet: float = 0.0
    """Share of the picture's rows that the bonnet's highest point covers; 0: out of sight."""
    reflection: float = 0.0
    """Share of a bright dashboard's light that the windscreen mirrors."""
    dirt: float = 0.0
    """Dirt on the windscreen, 0 to 1."""
    drops: float = 0.0
    """Share of the windscreen that rain drops cover just before a stroke of the wiper."""
    wipers: bool = False
    shape: int = 0
    """Seed of the shapes of bonnet, dirt, reflections and drops."""
