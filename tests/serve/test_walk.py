"""The way of an image through the modules of `serve`, as docs/architecture.md describes it."""

import re
import socket
import threading
from pathlib import Path
from types import FrameType

from tests.serve.attacks.conftest import Target, read_reply
from tests.serve.conftest import jpeg, picture, serving, until

ROOT = Path(__file__).parents[2]
LAYERS = ("scheduling", "observability", "api", "server")  # from low to high
MAX_MODULES = 12


class Recorder:
    """Records the functions of `serve` that run while `on` is set, each with the module that calls
    it ("" for the event loop). Leaves out the server's tick, which handles no image."""

    def __init__(self) -> None:
        self.on = False
        self.calls: list[tuple[str, str, str]] = []  # (module, function, calling module)

    def __call__(self, frame: FrameType, event: str, _argument: object) -> None:
        if not self.on or event != "call" or not module_of(frame):
            return
        stack = [frame]
        while (caller := stack[-1].f_back) is not None:
            stack.append(caller)
        if all(each.f_code.co_name != "on_tick" for each in stack):
            caller_module = next(filter(None, map(module_of, stack[1:])), "")
            self.calls.append((module_of(frame), frame.f_code.co_name, caller_module))


def module_of(frame: FrameType) -> str:
    """The module of `serve` that a frame belongs to, without "serve."; "" for other code."""
    file = Path(frame.f_code.co_filename)
    if not file.is_relative_to(ROOT / "serve"):
        return ""
    return ".".join(file.relative_to(ROOT / "serve").with_suffix("").parts)


def test_an_image_passes_the_modules_that_the_page_names() -> None:
    recorder = Recorder()
    threading.setprofile(recorder)  # for the threads that `serving` starts
    try:
        with serving() as service:
            target = Target(service.port)
            with target.dial() as connection:
                ask(target, connection)  # fills the caches
                recorder.on = True
                ask(target, connection)
                until(lambda: "on_response_complete" in {call[1] for call in recorder.calls})
                recorder.on = False
    finally:
        threading.setprofile(None)
    passed = list(dict.fromkeys(module for module, _, _ in recorder.calls))
    page = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
    walk = page.partition("### The way of an image")[2].partition("\n### ")[0]
    assert passed == re.findall(r"^\| \d+ \| `([\w.]+)` \|", walk, re.MULTILINE)
    assert len(passed) <= MAX_MODULES
    assert returns(recorder.calls) == ["read", "_on_result", "_reply"]


def ask(target: Target, connection: socket.socket) -> None:
    connection.sendall(target.post(jpeg(picture())))
    assert read_reply(connection)[0] == 200


def returns(calls: list[tuple[str, str, str]]) -> list[str]:
    """The functions that a lower layer calls, or that it has had the event loop call in `api`."""
    return [
        function
        for module, function, caller in calls
        if layer(module) > layer(caller) >= 0
        or (layer(module) == LAYERS.index("api") and not caller)
    ]


def layer(module: str) -> int:
    """The height of a module's layer; -1 for modules that all layers use, and for the loop."""
    name = module.partition(".")[0]
    return LAYERS.index(name) if name in LAYERS else -1
