"""A drive live in the browser: the page of `simulator watch`, with the perceived road beside the
truth."""

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
    """A function that shows the drive in `world` as it is now, at port `config.watch`, and holds it
    to real time.

    Raises UserError when the port is in use.
    """
    # On the wall clock the drive keeps to real time by itself.
    speed = None if config.realtime else 1.0
    port = 0 if config.watch is None else config.watch
    with Watcher(port=port, light=config.light, speed=speed, seed=config.seed) as watcher:

        def show(perceived: Perceived) -> None:
            offset = perceived.to_lane_centre
            to_middle = None if offset is None else offset + lane_centre
            watcher.update(world, Known(to_middle, perceived.angle))

        yield show
