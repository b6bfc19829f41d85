"""The options of one link server, with their defaults."""

from dataclasses import dataclass
from pathlib import Path

from trackfeatures import LANE_WIDTH_M

DEFAULT_NAME = "/driverview"
"""Name of the shared memory."""


@dataclass(frozen=True)
class LinkConfig:
    """The options of one link server."""

    track: str = "circuit"
    name: str = DEFAULT_NAME
    lanes: int = 1
    lane_width: float = LANE_WIDTH_M
    traffic: int = 0
    frequency_hz: int = 20
    seed: int = 0
    picture: tuple[int, int] = (0, 0)
    """Width and height of the camera images, (0, 0) for none."""
    light: str = "clear"
    tracks_dir: Path | None = None
    realtime: bool = False
    once: bool = False
    patience_s: float = 600.0
    """Longest wait for a command of a living client; 0: without limit."""
