"""The options of a link server, with their defaults."""

from dataclasses import dataclass
from typing import Annotated

from typer import Option

from simulator.track.cli import Lanes, LaneWidth, TracksDir, Traffic
from trackfeatures import LANE_WIDTH_M

DEFAULT_NAME = "/driverview"
"""Default name of the shared memory."""


@dataclass(frozen=True)
class LinkConfig:
    """The options of one link server."""

    track: Annotated[str, Option(help="Name of a track, or a track file.")] = "circuit"
    name: Annotated[str, Option(help="Name of the shared memory, such as /driverview.")] = (
        DEFAULT_NAME
    )
    lanes: Lanes = 1
    lane_width: LaneWidth = LANE_WIDTH_M
    traffic: Traffic = 0
    frequency_hz: Annotated[
        int, Option("--frequency", help="Control steps per second; a divisor of 200.")
    ] = 20
    seed: Annotated[
        int, Option(help="Seed of scenery and light, and of resets without a seed.", min=0)
    ] = 0
    picture: tuple[int, int] = (0, 0)
    """Width and height of the camera images in px; (0, 0): no images."""
    light: Annotated[str, Option(help="Light of the images, such as clear or rain.")] = "clear"
    tracks_dir: TracksDir = None
    realtime: Annotated[
        bool,
        Option(
            "--realtime/--lock-step",
            help="Step by the wall clock and hold the last command, or wait for a command before "
            "each step.",
        ),
    ] = False
    once: Annotated[bool, Option("--once", help="End when the first client disconnects.")] = False
    patience_s: Annotated[
        float,
        Option(
            "--patience",
            help="Longest wait for a client's command, s; then the server ends. 0: no limit.",
        ),
    ] = 600.0
