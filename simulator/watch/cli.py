"""The options of `simulator watch`.

simulator watch --track coast --lanes 2 --traffic 6 --light overcast --port 8765
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

from simulator.track.cli import Lanes, TracksDir, Traffic


@dataclass(frozen=True)
class WatchConfig:
    """The options of `simulator watch`."""

    track: str = "circuit"
    lanes: int = 1
    traffic: int = 0
    light: str = "clear"
    host: str = "127.0.0.1"
    port: int = 8765
    """0: any free port, which the first line names."""
    speed: float = 1.0
    """Simulated seconds per second of wall-clock time."""
    seed: int = 0
    tracks_dir: Path | None = None


def watch(
    track: Annotated[str, typer.Option(help="Name of a track, or its file.")] = WatchConfig.track,
    lanes: Lanes = WatchConfig.lanes,
    traffic: Traffic = WatchConfig.traffic,
    light: Annotated[
        str, typer.Option(help="Kind of light, such as overcast or rain.")
    ] = WatchConfig.light,
    host: Annotated[str, typer.Option(help="Address to listen on.")] = WatchConfig.host,
    port: Annotated[
        int, typer.Option(help="Port to listen on; 0: any free port.", min=0, max=65535)
    ] = WatchConfig.port,
    speed: Annotated[
        float, typer.Option(help="Speed of the drive as a multiple of real time.")
    ] = WatchConfig.speed,
    seed: Annotated[
        int, typer.Option(help="Seed of scenery, light and traffic.", min=0)
    ] = WatchConfig.seed,
    tracks_dir: TracksDir = WatchConfig.tracks_dir,
) -> None:
    """Watch a live drive in the browser, and take the wheel with the arrow keys.

    Shows several camera views, the plan of the track and the sensors. The first line on stderr is
    the address; this machine needs no display. Ctrl-C ends it.
    """
    from simulator.watch.command import watch as run

    run(WatchConfig(track, lanes, traffic, light, host, port, speed, seed, tracks_dir))
