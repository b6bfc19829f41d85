"""Runs a link server with the given options: builds the world, compiles its functions, and
serves."""

import os
import signal
from collections.abc import Callable
from contextlib import ExitStack
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from runtime.signals import interrupts
from simulator.link.config import LinkConfig
from simulator.link.handshake import ServerInfo
from simulator.link.layout import COMMAND, STATE, Mode, Request, image_bytes
from simulator.link.segment import remove_stale
from simulator.link.server import LinkServer, Summary
from simulator.link.simulation import Simulation
from simulator.link.sync import futex
from simulator.sensors.beams import BEAM_ANGLES
from simulator.track.catalogue import find_track
from simulator.track.road import Road
from simulator.world.world import World
from trackfeatures.camera import CameraParameters
from trackfeatures.errors import UserError

if TYPE_CHECKING:
    from simulator.camera import Camera


def run(config: LinkConfig, report: Callable[[str], None]) -> Summary:
    """Serve until a client sends QUIT, or until SIGINT or SIGTERM; `report` receives log lines.
    Returns the numbers of clients, episodes, steps and refused commands.

    Raises UserError for bad options, and ClientLost if a client sends nothing for `patience_s`, or
    if a client dies and `once` is set.
    """
    futex.check_system()
    if not config.patience_s >= 0.0:  # NaN too
        raise UserError(f"--patience is {config.patience_s}; give seconds, or 0 for no limit")
    remove_stale(config.name)  # raises for a name in use, before the world is built
    with ExitStack() as stack:
        road = Road(find_track(config.track, config.tracks_dir), config.lanes, config.lane_width)
        world = stack.enter_context(
            World(road, traffic=config.traffic, frequency_hz=config.frequency_hz)
        )
        camera = stack.enter_context(_camera(road, config)) if config.picture[0] else None

        def simulation(record: Any, image: NDArray[np.uint8]) -> Simulation:
            return Simulation(world, record, image, seed=config.seed, camera=camera)

        _warm_up(simulation, config)
        # Before the server: a signal while it starts or ends must not keep it from removing the
        # segment.
        interrupted = stack.enter_context(interrupts(signal.SIGINT, signal.SIGTERM))
        server = stack.enter_context(
            LinkServer(
                config.name,
                describe(world, config),
                simulation,
                once=config.once,
                patience_s=config.patience_s,
                report=report,
            )
        )
        report(f"{config.name}: {road.track.name} is ready for a client")
        server.serve(interrupted)
        if interrupted():
            report(f"{config.name}: stopped")
        return server.summary


def describe(world: World, config: LinkConfig) -> ServerInfo:
    """Return the properties of the server for the header."""
    road = world.road
    return ServerInfo(
        track=road.track.name,
        lanes=road.lanes,
        lane_width=road.lane_width,
        track_length=road.track.length_m,
        half_width=road.half_width,
        edge=road.edge,
        steering_lock=world.car.steering_lock,
        traffic=config.traffic,
        frequency_hz=world.frequency_hz,
        mode=Mode.REALTIME if config.realtime else Mode.LOCK_STEP,
        image_width=config.picture[0],
        image_height=config.picture[1],
        engine_pid=os.getpid(),
        beam_angles=tuple(BEAM_ANGLES.tolist()),
    )


def _warm_up(
    simulation: Callable[[Any, NDArray[np.uint8]], Simulation], config: LinkConfig
) -> None:
    """Compile all functions and render a first image before the first client connects. `simulation`
    builds the Simulation."""
    state, command = np.zeros(1, STATE.dtype)[0], np.zeros(1, COMMAND.dtype)[0]
    trial = simulation(state, np.zeros(image_bytes(*config.picture), np.uint8))
    for request in (Request.RESET, Request.STEP):
        command["request"], command["start_s"] = request, np.nan
        trial.answer(command)


def _camera(road: Road, config: LinkConfig) -> "Camera":
    from simulator.camera import open_camera  # loads the renderer only when images are needed

    return open_camera(
        road, CameraParameters(*config.picture), light=config.light, seed=config.seed
    )
