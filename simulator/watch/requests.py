"""The requests of a browser: its view, keys held down, pause, reset, light, driver."""

import json
from dataclasses import dataclass
from typing import Final, Literal

from simulator.camera import KINDS, VIEWS
from trackfeatures.errors import UserError

Kind = Literal["got", "view", "keys", "pause", "reset", "light", "driver"]

KEYS: Final = ("left", "right", "up", "down")
DRIVERS: Final = ("built-in", "keyboard")
MAX_BYTES: Final = 512


@dataclass(frozen=True)
class BrowserRequest:
    """One validated message of a browser."""

    kind: Kind
    value: str | int | bool | frozenset[str] = True


class BadRequest(UserError):
    """Raised for a message that does not follow the page's protocol."""


def parse(text: str) -> BrowserRequest:
    """Parse a JSON message {KIND: VALUE} to a request. Raises BadRequest for any other text."""
    try:
        message = json.loads(text) if len(text) <= MAX_BYTES else None
    except (ValueError, RecursionError):
        message = None
    if not isinstance(message, dict) or len(message) != 1:
        raise BadRequest('expected one JSON object such as {"view": "chase"}')
    ((kind, value),) = message.items()
    if kind == "got" and isinstance(value, int) and not isinstance(value, bool):
        return BrowserRequest("got", value)
    if kind == "view" and value in VIEWS:
        return BrowserRequest("view", value)
    if kind == "light" and value in KINDS:
        return BrowserRequest("light", value)
    if kind == "driver" and value in DRIVERS:
        return BrowserRequest("driver", value)
    if kind == "pause" and isinstance(value, bool):
        return BrowserRequest("pause", value)
    if kind == "reset" and value is True:
        return BrowserRequest("reset")
    if kind == "keys" and isinstance(value, list) and all(key in KEYS for key in value):
        return BrowserRequest("keys", frozenset(value))
    raise BadRequest(f"{kind!r} with {value!r} is not understood")
