"""Controls a headless Chromium through chromedriver (W3C WebDriver over HTTP)."""

import json
import shutil
import socket
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.error import URLError
from urllib.request import Request, urlopen

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
DRIVER = shutil.which("chromedriver")
MISSING = "no chromium with its driver (Debian: apt-get install chromium chromium-driver)"
ELEMENT = "element-6066-11e4-a52e-4f735466cecf"  # the standard's key for a reference to an element
OPTIONS = (
    "--headless=new", "--no-sandbox", "--disable-gpu", "--use-fake-ui-for-media-stream",
    "--use-fake-device-for-media-stream",
)  # fmt: skip


@dataclass
class Browser:
    """A browser session with a fake webcam, which shows a green picture with a clock."""

    url: str

    def open(self, page: str) -> None:
        self._ask("POST", "/url", {"url": page})

    def run(self, script: str) -> Any:
        """The value that `script`, the body of a function, returns in the page."""
        return self._ask("POST", "/execute/sync", {"script": script, "args": []})

    def wait(self, script: str, seconds: float = 20.0) -> Any:
        """Wait until the expression `script` is true; returns its value."""
        end = time.monotonic() + seconds
        while not (found := self.run(f"return {script}")):
            assert time.monotonic() < end, f"{script} is not true after {seconds} s"
            time.sleep(0.05)
        return found

    def choose_file(self, selector: str, path: Path) -> None:
        found = self._ask("POST", "/element", {"using": "css selector", "value": selector})
        self._ask("POST", f"/element/{found[ELEMENT]}/value", {"text": str(path)})

    def _ask(self, method: str, path: str, body: dict[str, Any]) -> Any:
        return ask(method, self.url + path, body)


def ask(method: str, url: str, body: dict[str, Any] | None = None) -> Any:
    data = None if body is None else json.dumps(body).encode()
    request = Request(url, data, {"Content-Type": "application/json"}, method=method)
    with urlopen(request, timeout=60) as reply:
        return json.load(reply)["value"]


@contextmanager
def open_browser(folder: Path) -> Iterator[Browser]:
    """A browser session; `folder` is for the browser's profile."""
    assert DRIVER is not None
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    driver = subprocess.Popen([DRIVER, f"--port={port}"], stdout=subprocess.DEVNULL)
    try:
        base = f"http://127.0.0.1:{port}"
        _wait_until_ready(base)
        chrome = {"binary": CHROMIUM, "args": [*OPTIONS, f"--user-data-dir={folder}"]}
        wanted = {"capabilities": {"alwaysMatch": {"goog:chromeOptions": chrome}}}
        session = ask("POST", f"{base}/session", wanted)["sessionId"]
        try:
            yield Browser(f"{base}/session/{session}")
        finally:
            ask("DELETE", f"{base}/session/{session}")
    finally:
        driver.terminate()
        driver.wait(10)


def _wait_until_ready(base: str) -> None:
    end = time.monotonic() + 20
    while True:
        try:
            if ask("GET", f"{base}/status")["ready"]:
                return
        except URLError:
            pass
        assert time.monotonic() < end, "chromedriver does not start"
        time.sleep(0.05)
