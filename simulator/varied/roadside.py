"""What stands close to the road in one scene. Defaults are today's pictures."""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Roadside:
    """What stands close to the road in one scene."""
