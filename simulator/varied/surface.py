"""The road's surface in one scene. Defaults are today's pictures."""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Surface:
    """The road's surface in one scene."""
