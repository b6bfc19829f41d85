"""The command `simulator watch`, which drives and serves until Ctrl-C.

simulator watch --track coast --lanes 2 --traffic 6 --light overcast --port 8765
"""

import signal
import socket
import sys
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Final

from typer import Option

from runtime.options import options_of
from simulator.track.cli import Lanes, TracksDir, Traffic

if TYPE_CHECKING:
    from simulator.track.road import Road

FREQUENCY_HZ: Final = 20


@dataclass(frozen=True)
class WatchConfig:
    """The options of `simulator watch`."""

    track: Annotated[
        str, Option(help="Name of a track (`simulator tracks` lists the names), or its file.")
    ] = "circuit"
    lanes: Lanes = 1
    traffic: Traffic = 0
    light: Annotated[
        str,
        Option(help="Light and weather: clear, overcast, dusk, fog, heavy-shadow, rain or snow."),
    ] = "clear"
    host: Annotated[
        str,
        Option(help="Address of the page. With the default, only this machine can reach the page."),
    ] = "127.0.0.1"
    port: Annotated[int, Option(help="Port of the page; 0: any free port.", min=0, max=65535)] = (
        8765
    )
    speed: Annotated[
        float, Option(help="Speed of the simulation as a multiple of real time, 0.05 to 100.")
    ] = 1.0
    seed: Annotated[
        int, Option(help="Seed of the scenery, the details of the light and the traffic.", min=0)
    ] = 0
    tracks_dir: TracksDir = None


@options_of(WatchConfig)
def watch(config: WatchConfig) -> None:
    """Watch a live drive in the browser, and drive the car with the arrow keys.

    The page shows several camera views, the plan of the track and the sensors. Its address is the
    first line on stderr. This machine needs no display. Ctrl-C ends the command.
    """
    from runtime.sockets import bind
    from simulator.camera import check_light
    from simulator.camera.core.context import graphics
    from simulator.track.catalogue import find_track
    from simulator.track.road import Road
    from simulator.world.pace import check_speed

    road = Road(find_track(config.track, config.tracks_dir), config.lanes)
    check_light(config.light)
    check_speed(config.speed)
    with bind(config.host, config.port) as listener:
        listener.listen()
        graphics()
        _drive(road, config, listener)


def _drive(road: "Road", config: WatchConfig, listener: socket.socket) -> None:
    from runtime.signals import interrupts
    from runtime.sockets import address
    from simulator.watch.drive import Drive
    from simulator.watch.hub import Hub
    from simulator.watch.server import Server
    from simulator.world.world import World

    hub = Hub()
    with World(road, traffic=config.traffic, frequency_hz=FREQUENCY_HZ) as world:
        drive = Drive(world, hub, light=config.light, seed=config.seed, speed=config.speed)
        server = Server(hub, listener)
        try:
            server.start()
            url = address(listener, config.host)
            sys.stderr.write(f"watch {road.track.name} at {url} (Ctrl-C ends it)\n")
            sys.stderr.flush()
            with interrupts(signal.SIGINT) as interrupted:
                while not interrupted():
                    drive.advance()
        finally:
            server.stop()
            drive.close()
    raise KeyboardInterrupt
