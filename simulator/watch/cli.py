"""The options of `simulator watch`.

simulator watch --track coast --lanes 2 --traffic 6 --light overcast --port 8765
"""

from typing import Annotated

import typer

from simulator.track.cli import TracksDir


def watch(
    track: Annotated[str, typer.Option(help="Name of a track, or its file.")] = "circuit",
    lanes: Annotated[int, typer.Option(help="Number of lanes, 1 to 3.")] = 1,
    traffic: Annotated[int, typer.Option(help="Number of other cars.", min=0, max=12)] = 0,
    light: Annotated[str, typer.Option(help="Kind of light, such as overcast or rain.")] = "clear",
    host: Annotated[str, typer.Option(help="Address to listen on.")] = "127.0.0.1",
    port: Annotated[
        int, typer.Option(help="Port to listen on; 0: any free one.", min=0, max=65535)
    ] = 8765,
    speed: Annotated[float, typer.Option(help="Times real time.")] = 1.0,
    seed: Annotated[int, typer.Option(help="Fixes scenery, light and traffic.", min=0)] = 0,
    tracks_dir: TracksDir = None,
) -> None:
    """Watch a live drive in the browser, and take the wheel with the arrow keys.

    Shows several camera views, the plan of the track and the sensors. The first line on stderr is
    the address; this machine needs no display. Ctrl-C ends it.
    """
    from simulator.watch.command import WatchConfig
    from simulator.watch.command import watch as run

    run(WatchConfig(track, lanes, traffic, light, host, port, speed, seed, tracks_dir))
