"""Exchange between a drive (one thread) and its browsers (the server's event loop).

The drive never waits: a new state or image replaces an older one that a browser has not fetched. A
new state wakes the browsers.
"""

import asyncio
import threading
from dataclasses import dataclass, field

from simulator.watch.requests import BrowserRequest

MAX_BROWSERS = 16
MAX_REQUESTS = 256
MAX_UNANSWERED = 2
"""Largest number of unanswered messages per browser; further states are then skipped."""


@dataclass(frozen=True)
class Snapshot:
    """The latest state as JSON, and the last image (JPEG) of each view."""

    number: int
    scene: str
    """The constant data of one road, as JSON."""
    state: str
    pictures: dict[str, tuple[int, bytes]]
    """For each view by name: the number of the state that the image shows, and the JPEG."""


@dataclass(eq=False)
class Browser:
    """One connected page: the view that it shows, the messages sent to it, and the number of
    messages that it has answered."""

    view: str
    changed: asyncio.Event = field(default_factory=asyncio.Event)
    sent: int = 0
    answered: int = 0
    scene: str | None = None
    picture: tuple[str, int] = ("", 0)
    """View and number of the last picture sent."""
    pending: int = 0
    """Number of messages sent and not yet answered."""


class Hub:
    """Data shared by one drive and one server; both threads may call every method."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._browsers: set[Browser] = set()
        self._requests: list[tuple[Browser, BrowserRequest]] = []
        self._left: list[Browser] = []
        self._loop: asyncio.AbstractEventLoop | None = None
        self.latest: Snapshot | None = None

    # Called by the drive.

    def publish(self, number: int, scene: str, state: str, pictures: dict[str, bytes]) -> None:
        """Publish a state to all browsers. `number` counts the states, `scene` and `state` are JSON
        messages (see `messages`), and `pictures` are the JPEGs, by view, rendered for this
        state."""
        with self._lock:
            before = self.latest
            kept = before.pictures if before is not None and before.scene is scene else {}
            new = {view: (number, picture) for view, picture in pictures.items()}
            self.latest = Snapshot(number, scene, state, {**kept, **new})
            loop = self._loop
        if loop is not None and self._browsers:
            self._call(loop)

    def wanted_views(self) -> tuple[str, ...]:
        """Return the views that browsers show, each once."""
        with self._lock:
            return tuple(dict.fromkeys(browser.view for browser in self._browsers))

    @property
    def watching(self) -> int:
        """Number of connected browsers."""
        return len(self._browsers)

    def take_requests(self) -> tuple[list[tuple[Browser, BrowserRequest]], list[Browser]]:
        """Return the requests that browsers have sent since the last call, each with its browser,
        and the browsers that have disconnected since then."""
        with self._lock:
            requests, left = self._requests, self._left
            self._requests, self._left = [], []
        return requests, left

    # Called by the server, in its event loop.

    def join(self, view: str) -> Browser | None:
        """Register a new browser that shows `view`; returns None if there are too many browsers."""
        with self._lock:
            self._loop = asyncio.get_running_loop()
            if len(self._browsers) >= MAX_BROWSERS:
                return None
            browser = Browser(view)
            self._browsers.add(browser)
        browser.changed.set()
        return browser

    def leave(self, browser: Browser) -> None:
        with self._lock:
            self._browsers.discard(browser)
            self._left.append(browser)

    def submit(self, browser: Browser, request: BrowserRequest) -> None:
        """Queue a browser's request for the drive. If more than 256 requests wait, the oldest
        request is removed."""
        with self._lock:
            self._requests.append((browser, request))
            del self._requests[:-MAX_REQUESTS]

    def _call(self, loop: asyncio.AbstractEventLoop) -> None:
        try:
            loop.call_soon_threadsafe(self._wake)
        except RuntimeError:  # the server has just ended
            self._loop = None

    def _wake(self) -> None:
        for browser in self._browsers:
            browser.changed.set()
