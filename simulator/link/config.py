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

    track: Annotated[
        str, Option(help="Name of a track (`simulator tracks` lists the names), or its file.")
    ] = "circuit"
    name: Annotated[
        str,
        Option(
            help="Name of the shared memory, with a slash at its start. The client opens the "
            "memory by this name."
        ),
    ] = DEFAULT_NAME
    lanes: Lanes = 1
    lane_width: LaneWidth = LANE_WIDTH_M
    traffic: Traffic = 0
    frequency_hz: Annotated[
        int, Option("--frequency", help="Number of control steps per second, a divisor of 200.")
    ] = 20
    seed: Annotated[
        int,
        Option(
            help="Seed of the scenery, of the details of the light, and of each reset for which "
            "the client gives no seed.",
            min=0,
        ),
    ] = 0
    picture: tuple[int, int] = (0, 0)
    """Width and height of the camera images in px; (0, 0): no images."""
    light: Annotated[
        str,
        Option(
            help="Light and weather in the images: clear, overcast, dusk, fog, heavy-shadow, "
            "rain, snow."
        ),
    ] = "clear"
    tracks_dir: TracksDir = None
    realtime: Annotated[
        bool,
        Option(
            "--realtime/--lock-step",
            help="--realtime: control steps follow the wall clock, and the last command is "
            "held until a new one arrives. --lock-step: each control step waits for a "
            "command.",
        ),
    ] = False
    once: Annotated[
        bool, Option("--once", help="End the server when its first client disconnects.")
    ] = False
    patience_s: Annotated[
        float,
        Option(
            "--patience",
            help="Longest time without a command from a connected client, s, after which the "
            "server ends. 0: no limit.",
        ),
    ] = 600.0
