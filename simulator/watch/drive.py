"""The drive that `simulator watch` shows, by the built-in driver or by a browser's keys."""

import sys
import time
from typing import Final

import trackfeatures as tf
from simulator.driving.cruise import Cruise
from simulator.vehicle.state import CarState, Command
from simulator.watch.episode_score import Score
from simulator.watch.hub import Browser, Hub
from simulator.watch.keyboard import Keyboard
from simulator.watch.messages import scene_message, state_message
from simulator.watch.pictures import JpegRenderer
from simulator.watch.requests import BrowserRequest
from simulator.watch.server import FIRST_VIEW
from simulator.world.errors import ContactsUnavailable
from simulator.world.pace import Pacer, Rate
from simulator.world.world import World

SHOW_S: Final = 1.0 / 26.0
"""Least interval (s of wall-clock time) between two updates of the browsers."""
MAX_IMAGE_AGE_S: Final = 0.25
"""Longest time for which images are skipped while the drive is late."""
ENDED_S: Final = 2.0
"""Time (s) for which the end of an episode is shown before the next episode begins."""


class Drive:
    """An endless drive in `world`; the requests of browsers arrive through `hub`.

    Raises NoRendererError if there is no renderer.
    """

    def __init__(
        self, world: World, hub: Hub, *, light: str = "clear", seed: int = 0, speed: float = 1.0
    ) -> None:
        self.world, self.hub = world, hub
        self.paused = False
        self.driver = "built-in"
        self._pacer = Pacer(1.0 / world.frequency_hz, speed)
        self._speed = speed
        self._cruise = Cruise(world.road, frequency_hz=world.frequency_hz)
        self._keyboard = Keyboard(world.road, world.frequency_hz)
        self._holder: Browser | None = None
        self._score = Score()
        self._rate, self._shown = Rate(), Rate()
        self._renderer = JpegRenderer(world.road, light, seed)
        self._seed, self._number = seed, 0
        self._ended_at: float | None = None
        self._last_show = self._last_picture = 0.0
        self._taken: set[str] = set()
        """Views that are already rendered for the current state."""
        self._scene = scene_message(world.road, controls=True)
        self._warm_up()
        self._start()

    def advance(self) -> None:
        """Do one control step, publish the new state to the browsers, and wait until the next step
        is due."""
        self._handle_requests()
        if self._ended_at is not None:
            if time.monotonic() - self._ended_at > ENDED_S:
                self._start()
        elif not self.paused:
            self._step()
        self._show()
        self._pacer.wait()

    def close(self) -> None:
        self._renderer.close()

    def _warm_up(self) -> None:
        """Compile all functions and build the scene before a browser waits for them. This takes
        seconds, and longer with an empty cache. It does not change the drive."""
        self.world.reset(seed=self._seed)
        for command in (
            self._cruise.command(self.world.state, self.world.traffic),
            self._keyboard.command(self.world.state),
        ):
            self.world.step(command)
        state_message(self.world)
        self._renderer.render(self.world, [FIRST_VIEW])

    def _start(self) -> None:
        """Start the next episode, with another seed and therefore other traffic."""
        road = self.world.road
        lane = tf.lane_centre(road.lanes - 1, road.lanes, road.lane_width)
        self.world.reset(seed=self._seed, to_middle=lane)
        self._seed += 1
        self._ended_at = None
        self._cruise.take_over()
        self._keyboard.release()
        self._score.count(self.world)
        self._taken.clear()

    def _step(self) -> None:
        try:
            self.world.step(self._command(self.world.state))
        except ContactsUnavailable as error:
            sys.stderr.write(f"{error}; the next episode begins\n")
            self._ended_at = time.monotonic()
            return
        self._rate.add(self._score.count(self.world))
        self._taken.clear()
        if self._score.ended is not None:
            self._ended_at = time.monotonic()

    def _command(self, state: CarState) -> Command:
        if self.driver == "keyboard":
            return self._keyboard.command(state)
        return self._cruise.command(state, self.world.traffic)

    def _handle_requests(self) -> None:
        requests, left = self.hub.take_requests()
        for browser, request in requests:
            self._handle_request(browser, request)
        if self._holder in left:
            self._release_controls()

    def _handle_request(self, browser: Browser, request: BrowserRequest) -> None:
        """Apply one request: keys, driver, pause, reset or light."""
        if request.kind == "keys" and isinstance(request.value, frozenset):
            if request.value:
                self.driver, self._holder = "keyboard", browser
            if browser is self._holder:
                self._keyboard.hold(request.value)
        elif request.kind == "driver":
            if request.value == "keyboard":
                self.driver, self._holder = "keyboard", browser
            else:
                self._release_controls()
        elif request.kind == "pause":
            self.paused = bool(request.value)
        elif request.kind == "reset":
            self._start()
        elif request.kind == "light":
            self._renderer.set_light(str(request.value))
            self._taken.clear()

    def _release_controls(self) -> None:
        """Return control to the built-in driver, which keeps the car's current lane."""
        self.driver, self._holder = "built-in", None
        self._keyboard.release()
        self._cruise.take_over()

    def _show(self) -> None:
        """Publish the state, and new pictures of the views that browsers show, once every
        SHOW_S."""
        now = time.monotonic()
        views = [view for view in self.hub.wanted_views() if view not in self._taken]
        if now - self._last_show < SHOW_S and not (self.paused and views):
            return
        self._last_show = now
        pictures: dict[str, bytes] = {}
        if views and (not self._pacer.late or now - self._last_picture > MAX_IMAGE_AGE_S):
            pictures = self._renderer.render(self.world, views)
            self._taken.update(views)
            self._last_picture = now
            self._shown.add(1.0)
        self._number += 1
        state = state_message(
            self.world,
            number=self._number,
            **self._score.as_dict(),
            paused=self.paused,
            driver=self.driver,
            light=self._renderer.light,
            rate=0.0 if self.paused else round(self._rate.value, 2),
            asked_rate=self._speed,
            pictures_per_s=round(self._shown.value, 1),
            watching=self.hub.watching,
        )
        self.hub.publish(self._number, self._scene, state, pictures)
