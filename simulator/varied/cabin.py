"""What of the car the camera sees in one scene. Defaults are today's pictures."""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Cabin:
    """What of the car the camera sees in one scene."""
