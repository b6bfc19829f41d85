"""The WebSocket of `simulator watch`: images, state messages, keyboard, several browsers."""

import json
import re
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, suppress
from http.client import HTTPConnection
from typing import Any

import numpy as np
import pytest
import simplejpeg
from numpy.typing import NDArray
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import ClientConnection, connect

from simulator.camera import VIEWS
from simulator.sensors.beams import RANGE_M
from simulator.track.catalogue import find_track
from simulator.track.road import Road
from simulator.vehicle.state import Command
from simulator.watch.drive import Drive
from simulator.watch.hub import MAX_BROWSERS, Hub
from simulator.watch.pictures import SIZE
from simulator.world.world import World

ROAD = Road(find_track("oval"), 2)


class Watched:
    """`simulator watch` on a free port in a subprocess."""

    def __init__(self) -> None:
        flags = ["--track", "oval", "--lanes", "2", "--traffic", "3", "--port", "0", "--speed", "2"]
        self._process = subprocess.Popen(
            [sys.executable, "-m", "simulator", "watch", *flags], stderr=subprocess.PIPE, text=True
        )
        assert self._process.stderr is not None
        for line in self._process.stderr:
            if found := re.search(r"http://127\.0\.0\.1:(\d+)", line):
                self.port = int(found[1])
                return
        raise AssertionError("the drive did not begin")

    def close(self) -> None:
        self._process.send_signal(signal.SIGINT)
        try:
            assert self._process.wait(timeout=120) == 130
        finally:
            self._process.kill()
            self._process.communicate()

    def browser(self) -> "Page":
        return Page(self.port)


class Page:
    """A client with the page's protocol: reads and acknowledges messages, sends requests."""

    def __init__(self, port: int) -> None:
        self._open = ExitStack()
        self.line: ClientConnection = self._open.enter_context(
            connect(f"ws://127.0.0.1:{port}/live", max_size=None)
        )
        self.scene: dict[str, Any] = json.loads(self.line.recv(timeout=120))

    def state(self) -> dict[str, Any]:
        """The next state; pictures between are dropped."""
        state: dict[str, Any] = self._next(str)
        return state

    def picture(self) -> NDArray[np.uint8]:
        image: NDArray[np.uint8] = simplejpeg.decode_jpeg(self._next(bytes))
        return image

    def until(self, good: Any, timeout_s: float = 120.0) -> dict[str, Any]:
        end = time.monotonic() + timeout_s
        while time.monotonic() < end:
            state = self.state()
            if good(state):
                return state
        raise AssertionError(f"waited {timeout_s} s in vain; the last state was {state}")

    def picture_until(
        self, good: Callable[[NDArray[np.uint8]], bool], timeout_s: float = 120.0
    ) -> NDArray[np.uint8]:
        end = time.monotonic() + timeout_s
        while time.monotonic() < end:
            picture = self.picture()
            if good(picture):
                return picture
        raise AssertionError(f"no such picture in {timeout_s} s")

    def ask(self, **message: Any) -> None:
        self.line.send(json.dumps(message))

    def _next(self, kind: type) -> Any:
        while True:
            data = self.line.recv(timeout=120)
            if isinstance(data, str):
                message = json.loads(data)
                self.ask(got=message["number"])
                data = message if kind is str else data
            if isinstance(data, dict if kind is str else bytes):
                return data

    def __enter__(self) -> "Page":
        return self

    def __exit__(self, *_: object) -> None:
        self._open.close()


def until_quiet(page: Page, quiet_s: float) -> list[str | bytes]:
    """All messages until none arrives for the given time."""
    found: list[str | bytes] = []
    with suppress(TimeoutError):
        while True:
            found.append(page.line.recv(timeout=quiet_s))
    return found


def drain(page: Page) -> None:
    """Read messages until the connection is closed, which raises."""
    while True:
        page.line.recv(timeout=120)


@pytest.fixture(scope="module")
def watched() -> Iterator[Watched]:
    watched = Watched()
    yield watched
    watched.close()


def test_the_page_is_self_contained(watched: Watched) -> None:
    connection = HTTPConnection("127.0.0.1", watched.port, timeout=120)
    connection.request("GET", "/")
    response = connection.getresponse()
    text = response.read().decode()
    assert response.status == 200
    assert "default-src 'none'" in (response.getheader("Content-Security-Policy") or "")
    assert text.count("http") == 1  # the choice between ws: and wss:
    assert "src=" not in text


def test_scene_message_matches_the_road(watched: Watched) -> None:
    with watched.browser() as page:
        scene = page.scene
    assert (scene["track"], scene["lanes"], scene["controls"]) == ("oval", 2, True)
    assert scene["markings"] == [4.0, 0.0, -4.0]
    assert scene["views"] == list(VIEWS)
    k = 100
    pose = ROAD.track.at(k * ROAD.track.length_m / len(scene["x"]))
    assert [scene["x"][k], scene["y"][k]] == pytest.approx([float(pose.x), float(pose.y)], abs=0.01)


def test_state_messages_match_the_road(watched: Watched) -> None:
    with watched.browser() as page:
        page.ask(reset=True)
        page.until(lambda state: state["time_s"] < 1.0)
        state = page.until(lambda state: state["time_s"] > 5.0)
        later = page.until(lambda other: other["time_s"] > state["time_s"])
    assert state["driver"] == "built-in"
    assert 10.0 < state["speed_kmh"] < 62.0
    s, to_middle = ROAD.track.project(state["x"], state["y"], state["s"])
    assert (s, to_middle) == pytest.approx((state["s"], state["to_middle"]), abs=0.02)
    # In the middle of the right lane of two.
    assert to_middle == pytest.approx(-2.0, abs=0.3)
    # The left marking of that lane is the middle of the road.
    assert state["distances_m"]["ml"] == pytest.approx(to_middle, abs=0.01)
    assert len(state["beams"]) == len(page.scene["beam_angles"]) == 19
    assert state["beams"][0] == pytest.approx(ROAD.edge - to_middle, abs=0.3)
    assert 0.0 < min(state["beams"]) <= max(state["beams"]) <= RANGE_M
    assert len(state["traffic"]) == 3
    assert state["steps"] == round(state["time_s"] * 20)
    # 2 m off the middle of 14 m: cos 0 - 2/7.
    assert state["score_per_step"] == pytest.approx(1.0 - 2.0 / 7.0, abs=0.03)
    moved = later["s"] - state["s"]
    assert moved == pytest.approx(
        state["speed_kmh"] / 3.6 * (later["time_s"] - state["time_s"]), rel=0.2
    )


def test_images_are_of_the_selected_view(watched: Watched) -> None:
    with watched.browser() as page:
        page.ask(view="front")
        front = page.picture_until(lambda picture: picture[:20, :, 2].mean() > 140.0)  # sky
        assert front.shape == (SIZE[1], SIZE[0], 3)
        page.picture_until(lambda later: np.abs(front.astype(int) - later).mean() > 0.5)  # it moves
        page.ask(view="top")
        top = page.picture_until(lambda picture: picture[:20, :, 2].mean() < 130.0)  # ground
        assert np.abs(front.astype(int) - top).mean() > 15.0


def test_a_light_request_changes_the_images(watched: Watched) -> None:
    """Images in flight still have the earlier light, so wait for the sky of the new light."""
    with watched.browser() as page:
        page.ask(view="front")
        page.ask(light="dusk")
        page.until(lambda state: state["light"] == "dusk")
        dusk = page.picture_until(lambda picture: picture[:20, :, 2].mean() < 185.0)
        page.ask(light="clear")
        page.until(lambda state: state["light"] == "clear")
        clear = page.picture_until(lambda picture: picture[:20, :, 2].mean() > 195.0)
        assert clear.mean() > dusk.mean() + 10.0


def test_keys_take_control_and_a_disconnect_releases_it(watched: Watched) -> None:
    with watched.browser() as other:
        with watched.browser() as page:
            page.ask(reset=True)
            page.until(lambda state: state["time_s"] > 2.0)
            page.ask(keys=["left"])
            state = page.until(lambda state: state["steer"] > 0.05)
            assert state["driver"] == "keyboard"
            assert state["angle"] < 0.1
            page.ask(keys=["down"])
            page.until(lambda state: state["speed_kmh"] < 3.0)
            assert page.state()["driver"] == "keyboard"
        other.until(lambda state: state["driver"] == "built-in")
        other.ask(reset=True)
        other.until(lambda state: state["speed_kmh"] > 10.0)


def test_keys_are_released_when_a_browser_stops_sending(watched: Watched) -> None:
    with watched.browser() as page:
        page.ask(reset=True)
        page.until(lambda state: state["time_s"] > 2.0)
        page.ask(keys=["right"])
        page.until(lambda state: state["steer"] < -0.1)
        page.until(lambda state: state["steer"] > -0.02)
        page.ask(driver="built-in")
        page.ask(reset=True)


def test_pause_stops_the_drive_but_other_views_are_rendered(watched: Watched) -> None:
    with watched.browser() as page:
        page.ask(pause=True)
        stopped = page.until(lambda state: state["paused"])["time_s"]
        page.ask(view="left")
        left = page.picture()
        page.ask(view="right")
        right = page.picture()
        assert left.shape == right.shape
        for _ in range(5):
            assert page.state()["time_s"] == stopped
        page.ask(pause=False)
        page.until(lambda state: state["time_s"] > stopped)


def test_a_new_episode_begins_after_the_end_is_shown(watched: Watched) -> None:
    with watched.browser() as page:
        page.ask(reset=True)
        episode = page.until(lambda state: state["time_s"] > 3.0)["episode"]
        for _ in range(200):
            page.ask(keys=["left", "up"])
            state = page.state()
            if state["ended"]:
                break
        assert state["ended"] == "off_track"
        page.ask(driver="built-in")
        after = page.until(lambda state: state["ended"] is None)
        assert after["episode"] == episode + 1


@pytest.mark.alone
def test_a_browser_that_does_not_read_does_not_delay_others(watched: Watched) -> None:
    deaf = socket.create_connection(("127.0.0.1", watched.port))
    deaf.sendall(
        b"GET /live HTTP/1.1\r\nHost: x\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
        b"Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\nSec-WebSocket-Version: 13\r\n\r\n"
    )
    with watched.browser() as page, watched.browser() as mute:  # mute answers nothing either
        page.ask(reset=True)
        first, began = page.until(lambda state: state["time_s"] < 1.0), time.monotonic()
        numbers = [page.state()["number"] for _ in range(30)]
        assert numbers == sorted(set(numbers))
        last, took = page.state(), time.monotonic() - began
        # Twice real time, on an idle machine.
        assert last["time_s"] - first["time_s"] > 0.4 * took
        # Two states and their pictures wait for the mute browser, not thirty.
        waiting = until_quiet(mute, 1.0)
        states = [json.loads(data) for data in waiting if isinstance(data, str)]
        assert 1 <= len(states) <= 2
        assert len(waiting) <= 4
        # After it has answered, it gets the latest state, not the states it missed.
        mute.ask(got=states[-1]["number"])
        latest = json.loads(mute.line.recv(timeout=60))["number"]
        assert latest > numbers[-1] - 3
    deaf.close()


@pytest.mark.parametrize(
    "message",
    ["no json", "[1]", '{"view": "inside"}', '{"keys": ["q"]}', '{"keys": "left"}', '{"got": true}',
     '{"light": ["clear"]}', '{"pause": 1}', '{"view": "top", "reset": true}', "9" * 600],
)  # fmt: skip
def test_a_bad_message_closes_only_its_connection(watched: Watched, message: str) -> None:
    with watched.browser() as page, watched.browser() as good:
        page.line.send(message)
        with pytest.raises(ConnectionClosed, match="1008"):
            drain(page)
        assert good.state()["time_s"] >= 0.0


def test_pages_of_other_origins_are_refused(watched: Watched) -> None:
    url = f"ws://127.0.0.1:{watched.port}/live"
    with pytest.raises(InvalidStatus), connect(url, additional_headers={"Origin": "http://x.org"}):
        pass
    own = {"Origin": f"http://127.0.0.1:{watched.port}"}
    with connect(url, additional_headers=own) as line:
        assert json.loads(line.recv(timeout=120))["type"] == "scene"


def test_the_number_of_browsers_is_limited(watched: Watched) -> None:
    with ExitStack() as stack:
        pages = [stack.enter_context(watched.browser()) for _ in range(MAX_BROWSERS)]
        assert pages[0].until(lambda state: state["watching"] == MAX_BROWSERS)
        late = stack.enter_context(connect(f"ws://127.0.0.1:{watched.port}/live"))
        with pytest.raises(ConnectionClosed, match="1013"):
            late.recv(timeout=120)
    with watched.browser() as page:
        page.until(lambda state: state["watching"] == 1)


def test_a_contact_without_pybullet_ends_the_episode_not_the_drive(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "pybullet", None)
    monkeypatch.delitem(sys.modules, "simulator.world.physics", raising=False)
    with World(ROAD) as world:
        drive = Drive(world, Hub(), speed=100.0)
        monkeypatch.setattr(drive, "_command", lambda state: Command(gear=0))
        world.reset(seed=0, angle=-1.2, speed=20.0)
        for _ in range(40):
            drive.advance()
        assert capsys.readouterr().err.count("contacts need PyBullet") == 1
        monkeypatch.setattr("simulator.watch.drive.ENDED_S", 0.0)
        for _ in range(5):
            drive.advance()
        assert 0.0 < world.state.time_s < 1.0
        drive.close()
