"""What the commands `controllers drive` and `controllers demo` can be given, with the defaults."""

from dataclasses import dataclass
from pathlib import Path

THROTTLE = 0.2
"""Held open loop, in gear 1."""


@dataclass(frozen=True)
class DriveConfig:
    """One closed-loop drive. The same configuration gives the same drive, but for `realtime`."""

    controller: str = "lqr-preview"
    track: str = "oval"
    lanes: int = 1
    perception: str = "truth"
    """truth, model, or the address of a service."""
    steps: int | None = None
    """Control steps of 50 ms; None: the number that scores on this track use, else about a lap."""
    log: Path | None = None
    video: Path | None = None
    """A film of the drive (.mp4)."""
    watch: int | None = None
    """Port of the page that shows the drive live; 0: any free one."""
    latency_ms: float = 0.0
    """Of the perception's answers; the state is predicted over it."""
    drop: float = 0.0
    """Share of the answers that are lost."""
    realtime: bool = False
    """On the wall clock, without waiting for the perception's answers."""
    parameters: Path | None = None
    """A file of `controllers tune`, whose parameters the controller gets."""
    model: str = "default"
    """The run for perception `model`; default: the shipped one, else the latest."""
    start_d: float | None = None
    """m left of the track's centre; None: the middle of the target lane, or 0 without one."""
    target_lane: int | None = None
    """0 is the leftmost; None: the lane nearest to the start."""
    throttle: float | None = None
    """Held in gear 1; None: 0.2, or what `speed` needs."""
    speed: float | None = None
    """m/s to drive at, slower in bends and behind traffic; None: the throttle is held."""
    traffic: int = 0
    light: str = "clear"
    seed: int = 0
    tracks_dir: Path | None = None


@dataclass(frozen=True)
class CompareConfig:
    """A comparison: every controller on every track, with every perception and seed."""

    out: Path = Path("comparison")
    """Folder of results.json and report.html."""
    tracks: str = "forza,alpine-2,eroad,g-track-3"
    controllers: str = "lqr,lqr-preview,mpc,mpc-preview,torcs"
    perceptions: str = "truth"
    seeds: int = 1
    """Without disturbance and traffic all drives on the truth are equal."""
    disturb: bool = False
    steps: int | None = None
    """None: the paper's number on the track, else about a lap."""
    start_d: float | None = None
    """m left of the centre; None: TORCS's place on the grid, a sixth of the width to the right."""
    latency_ms: float = 0.0
    drop: float = 0.0
    model: str = "default"
    light: str = "clear"
    parameters: Path | None = None
    """A file of `controllers tune`, for the controllers in it."""
    tracks_dir: Path | None = None


@dataclass(frozen=True)
class TuneConfig:
    """A search for the parameters of several controllers with the same budget of drives."""

    out: Path = Path("tuned.json")
    controllers: str = "lqr,mpc"
    tracks: str = "forza"
    budget: int = 40
    """Drives on each track for each controller, the first of them with its own parameters."""
    reward: str = "paper"
    """paper, or quadratic: -(0.3 d^2 + angle^2 + 0.03 delta^2)."""
    steps: int | None = None
    disturbance: str = "none"
    seed: int = 0
    tracks_dir: Path | None = None


@dataclass(frozen=True, slots=True)
class DemoConfig:
    """What the demo collects and how long it trains; the defaults fit 17 minutes on two cores."""

    out: Path = Path("demo")
    tracks: str = "circuit,forest,highway,mountain-pass,ring-road"
    rounds: int = 300
    frames: int = 200
    seed: int = 1
    minutes: float = 8.5
    """Of training."""
    alpha: str = "0.3,0.2,0.5"
    """Task weights of the loss."""
    asked: int = 12
    """Held-out frames that are posted to the service."""
    drive_track: str = "highway"
    first_drive: bool = False
    """Stop after the first drive, which the shipped model answers."""
