"""The options of `simulator watch`.

simulator watch --track coast --lanes 2 --traffic 6 --light overcast --port 8765
"""

from dataclasses import dataclass
from typing import Annotated

from typer import Option

from runtime.options import options_of
from simulator.track.cli import Lanes, TracksDir, Traffic


@dataclass(frozen=True)
class WatchConfig:
    """The options of `simulator watch`."""

    track: Annotated[str, Option(help="Name of a track, or its file.")] = "circuit"
    lanes: Lanes = 1
    traffic: Traffic = 0
    light: Annotated[str, Option(help="Kind of light, such as overcast or rain.")] = "clear"
    host: Annotated[str, Option(help="Address to listen on.")] = "127.0.0.1"
    port: Annotated[int, Option(help="Port to listen on; 0: any free port.", min=0, max=65535)] = (
        8765
    )
    speed: Annotated[float, Option(help="Speed of the drive as a multiple of real time.")] = 1.0
    seed: Annotated[int, Option(help="Seed of scenery, light and traffic.", min=0)] = 0
    tracks_dir: TracksDir = None


@options_of(WatchConfig)
def watch(config: WatchConfig) -> None:
    """Watch a live drive in the browser, and take the wheel with the arrow keys.

    Shows several camera views, the plan of the track and the sensors. The first line on stderr is
    the address; this machine needs no display. Ctrl-C ends it.
    """
    from simulator.watch.command import watch as run

    run(config)
