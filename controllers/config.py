"""What the commands `controllers drive` and `controllers demo` can be given, with the defaults."""

from dataclasses import dataclass
from pathlib import Path

THROTTLE = 0.2
"""Held open loop, in gear 1."""


@dataclass(frozen=True)
class DriveConfig:
    """One closed-loop drive. The same configuration gives the same drive."""

    controller: str = "lqr-preview"
    track: str = "oval"
    lanes: int = 1
    perception: str = "truth"
    """truth, model, or the address of a service."""
    steps: int | None = None
    """Control steps of 50 ms; None: the number that scores on this track use, else about a lap."""
    log: Path | None = None
    model: str = "default"
    """The run for perception `model`; default: the shipped one, else the latest."""
    start_d: float | None = None
    """m left of the track's centre; None: the middle of the target lane, or 0 without one."""
    target_lane: int | None = None
    """0 is the leftmost; None: the lane nearest to the start."""
    throttle: float = THROTTLE
    traffic: int = 0
    light: str = "clear"
    seed: int = 0
    tracks_dir: Path | None = None


@dataclass(frozen=True, slots=True)
class DemoConfig:
    """What the demo collects and how long it trains; the defaults fit 15 minutes on two cores."""

    out: Path = Path("demo")
    tracks: str = "circuit,countryside,forest,highway,mountain-pass"
    rounds: int = 100
    frames: int = 200
    seed: int = 1
    minutes: float = 8.5
    """Of training."""
    alpha: str = "0.3,0.2,0.5"
    """Task weights of the loss."""
    asked: int = 12
    """Held-out frames that are posted to the service."""
    drive_track: str = "highway"
