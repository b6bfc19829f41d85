"""Runs `simulator watch`: checks the options, then drives and serves until Ctrl-C.

simulator watch --track coast --lanes 2 --traffic 6 --port 8765
"""

import signal
import socket
import sys
from typing import Final

from runtime.signals import interrupts
from runtime.sockets import address, bind
from simulator.camera import check_light
from simulator.camera.core.context import graphics
from simulator.track.catalogue import find_track
from simulator.track.road import Road
from simulator.watch.cli import WatchConfig
from simulator.world.pace import check_speed

FREQUENCY_HZ: Final = 20


def watch(config: WatchConfig) -> None:
    """Drive and serve until Ctrl-C. Raises UserError when it cannot begin."""
    road = Road(find_track(config.track, config.tracks_dir), config.lanes)
    check_light(config.light)
    check_speed(config.speed)
    with bind(config.host, config.port) as listener:
        listener.listen()
        graphics()
        _drive(road, config, listener)


def _drive(road: Road, config: WatchConfig, listener: socket.socket) -> None:
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
