"""Shows a drive of the user's own program in the browser, such as an agent in training."""

import sys
import time
from dataclasses import dataclass
from typing import Any, Final, Self

from runtime.sockets import address, bind
from simulator.track.road import Road
from simulator.watch.episode_score import Score
from simulator.watch.hub import Hub
from simulator.watch.messages import scene_message, state_message
from simulator.watch.pictures import JpegRenderer
from simulator.watch.server import Server
from simulator.world.pace import Pacer, Rate
from simulator.world.world import World
from trackfeatures.errors import UserError

SHOW_S: Final = 1.0 / 20.0
"""Least interval (s of wall-clock time) between two updates of the browsers."""


@dataclass(frozen=True, slots=True)
class Perceived:
    """A driver's estimate of its position, drawn beside the true values."""

    to_middle: float | None
    """Lateral offset from the track's centre, m, left positive; None if unknown."""
    angle: float
    """Heading angle: track tangent minus yaw, rad."""

    def as_dict(self) -> dict[str, float | None]:
        """Return the estimate as entries of the state message, by name."""
        offset = None if self.to_middle is None else round(self.to_middle, 3)
        return {"to_middle": offset, "angle": round(self.angle, 5)}


class Watcher:
    """Shows the world given to `update` in the browser, at the address `url`.

    Without a connected browser an update costs microseconds; with browsers, at most 20 pictures per
    second are drawn for each view. `speed` limits the drive to this multiple of real time; None
    sets no limit. `seed` determines the scenery. Only the thread that steps the environment may use
    the Watcher. Raises UserError if the port is in use.
    """

    def __init__(
        self,
        *,
        host: str = "127.0.0.1",
        port: int = 8765,
        light: str = "clear",
        speed: float | None = None,
        seed: int = 0,
    ) -> None:
        listener = bind(host, port)
        listener.listen()
        self.url = address(listener, host)
        self._hub = Hub()
        self._light, self._speed, self._seed = light, speed, seed
        self._score, self._rate, self._shown = Score(), Rate(), Rate()
        self._road: Road | None = None
        self._renderer: JpegRenderer | None = None
        self._pacer: Pacer | None = None
        self._number, self._last_show, self._scene = 0, 0.0, ""
        self._server = Server(self._hub, listener)
        self._server.start()
        sys.stderr.write(f"watch at {self.url}\n")

    def update(self, drive: Any, perceived: Perceived | None = None) -> None:
        """Show the current state of `drive`, which is a World or an environment of this package,
        wrapped or not. `perceived` is the driver's estimate of its position.

        Call it after every reset and step. Raises UserError for any other object, and
        NoRendererError without a renderer.
        """
        world = _world_of(drive)
        if world.road is not self._road:
            self._change_road(world)
        passed = self._score.count(world)
        self._rate.add(passed)
        self._handle_requests()
        now = time.monotonic()
        if self._hub.watching and now - self._last_show >= SHOW_S:
            self._last_show = now
            self._show(world, perceived)
        if self._pacer is not None and passed > 0.0:
            self._pacer.wait()

    def close(self) -> None:
        """End the server; browsers show that the drive has ended."""
        self._server.stop()
        if self._renderer is not None:
            self._renderer.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _change_road(self, world: World) -> None:
        if self._renderer is not None:
            self._renderer.close()
        self._road = world.road
        self._renderer = JpegRenderer(world.road, self._light, self._seed)
        self._scene = scene_message(world.road, controls=False)
        if self._speed is not None:
            self._pacer = Pacer(1.0 / world.frequency_hz, self._speed)

    def _handle_requests(self) -> None:
        """Handle requests for another light. Ignore all other requests, because they would change
        the drive."""
        requests, _ = self._hub.take_requests()
        for _, request in requests:
            if request.kind == "light" and self._renderer is not None:
                self._light = str(request.value)
                self._renderer.set_light(self._light)

    def _show(self, world: World, perceived: Perceived | None) -> None:
        assert self._renderer is not None
        pictures = self._renderer.render(world, self._hub.wanted_views())
        self._shown.add(1.0)
        self._number += 1
        state = state_message(
            world,
            number=self._number,
            **self._score.as_dict(),
            paused=False,
            driver="program",
            light=self._light,
            rate=round(self._rate.value, 2),
            asked_rate=self._speed,
            pictures_per_s=round(self._shown.value, 1),
            watching=self._hub.watching,
            **({} if perceived is None else {"perceived": perceived.as_dict()}),
        )
        self._hub.publish(self._number, self._scene, state, pictures)


def _world_of(drive: Any) -> World:
    world = getattr(getattr(drive, "unwrapped", drive), "world", drive)
    if not isinstance(world, World):
        raise UserError(
            f"a Watcher cannot show {type(drive).__name__}: pass a World or an environment of "
            "simulator.env; of the vector environments of simulator.env pass "
            "envs.unwrapped.world(0), of SyncVectorEnv envs.envs[0]"
        )
    return world
