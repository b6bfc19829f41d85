"""A live drive in the browser: the page of `simulator watch` with the true and perceived road."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from controllers.drive.config import DriveConfig
from controllers.perception.perceived import Perceived
from simulator.watch.watcher import Perceived as Known
from simulator.watch.watcher import Watcher
from simulator.world.world import World


@contextmanager
def watch(
    config: DriveConfig, world: World, lane_centre: float
) -> Iterator[Callable[[Perceived], None]]:
    """Serve the page at port `config.watch`; yield a function that shows the present state of
    `world` and a perceived road.

    Call the function once for each control step. It waits so that the drive runs in real time,
    except with `config.realtime`, which keeps the drive in real time by itself. `lane_centre` is
    the line to follow, m left of the track's centre. Raises UserError when the port is in use.
    """
    # A drive with `realtime` is in real time already.
    speed = None if config.realtime else 1.0
    port = 0 if config.watch is None else config.watch
    with Watcher(port=port, light=config.light, speed=speed, seed=config.seed) as watcher:

        def show(perceived: Perceived) -> None:
            offset = perceived.to_lane_centre
            to_middle = None if offset is None else offset + lane_centre
            watcher.update(world, Known(to_middle, perceived.angle))

        yield show
