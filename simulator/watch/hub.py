"""Where a drive leaves its newest state and pictures, and browsers pick them up.

The drive (one thread) never waits: what a browser did not fetch in time is replaced by what is
newer. Browsers live in the server's event loop and are woken when something new is there.
"""

import asyncio
import threading
from dataclasses import dataclass, field

from simulator.watch.requests import Order

MOST_BROWSERS = 16
MOST_ORDERS = 256
IN_FLIGHT = 2
"""Messages a browser may owe an answer to; on a slow line the next one then is a new one."""


@dataclass(frozen=True)
class Newest:
    """What there is to show: the state as JSON, and of each view the last picture (JPEG)."""

    number: int
    scene: str
    """What does not change while one road is driven, as JSON."""
    state: str
    pictures: dict[str, tuple[int, bytes]]
    """By view, with the number of the state it was taken at."""


@dataclass(eq=False)
class Browser:
    """One connected page."""

    view: str
    changed: asyncio.Event = field(default_factory=asyncio.Event)
    sent: int = 0
    answered: int = 0
    scene: str | None = None
    picture: tuple[str, int] = ("", 0)
    """View and number of the last picture sent."""
    pending: int = 0
    """Messages sent and not yet answered."""


class Hub:
    """Shared by one drive and one server; every method may be called from either's thread."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._browsers: set[Browser] = set()
        self._orders: list[tuple[Browser, Order]] = []
        self._left: list[Browser] = []
        self._loop: asyncio.AbstractEventLoop | None = None
        self.newest: Newest | None = None

    # The drive's side.

    def publish(self, number: int, scene: str, state: str, pictures: dict[str, bytes]) -> None:
        """Replace what there is to show; `pictures` holds those that are new."""
        with self._lock:
            before = self.newest
            kept = before.pictures if before is not None and before.scene is scene else {}
            new = {view: (number, picture) for view, picture in pictures.items()}
            self.newest = Newest(number, scene, state, {**kept, **new})
            loop = self._loop
        if loop is not None and self._browsers:
            self._call(loop)

    def wanted_views(self) -> tuple[str, ...]:
        """The views that browsers look at, each once."""
        with self._lock:
            return tuple(dict.fromkeys(browser.view for browser in self._browsers))

    @property
    def watching(self) -> int:
        """How many browsers are connected."""
        return len(self._browsers)

    def take_orders(self) -> tuple[list[tuple[Browser, Order]], list[Browser]]:
        """What browsers ask for since the last call, and which of them left."""
        with self._lock:
            orders, left = self._orders, self._left
            self._orders, self._left = [], []
        return orders, left

    # The server's side, in its event loop.

    def join(self, view: str) -> Browser | None:
        """A new browser; None when there are too many."""
        with self._lock:
            self._loop = asyncio.get_running_loop()
            if len(self._browsers) >= MOST_BROWSERS:
                return None
            browser = Browser(view)
            self._browsers.add(browser)
        browser.changed.set()
        return browser

    def leave(self, browser: Browser) -> None:
        with self._lock:
            self._browsers.discard(browser)
            self._left.append(browser)

    def order(self, browser: Browser, order: Order) -> None:
        """Pass on what a browser asks for; the oldest is lost when nobody takes them."""
        with self._lock:
            self._orders.append((browser, order))
            del self._orders[:-MOST_ORDERS]

    def _call(self, loop: asyncio.AbstractEventLoop) -> None:
        try:
            loop.call_soon_threadsafe(self._wake)
        except RuntimeError:  # the server has just ended
            self._loop = None

    def _wake(self) -> None:
        for browser in self._browsers:
            browser.changed.set()
