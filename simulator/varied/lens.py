"""What the lens and the sensor do to the pictures of one scene. Defaults are today's pictures."""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Lens:
    """What the lens and the sensor do to the pictures of one scene."""
