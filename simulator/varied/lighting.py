"""Light and exposure of one scene, beyond its kind of light. Defaults are today's pictures."""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Lighting:
    """Light and exposure of one scene, beyond its kind of light."""
