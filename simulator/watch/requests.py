"""What a browser may ask for: its view, keys held down, pause, reset, light, who drives."""

import json
from dataclasses import dataclass
from typing import Final, Literal

from simulator.camera import KINDS, VIEWS
from trackfeatures.errors import UserError

Kind = Literal["got", "view", "keys", "pause", "reset", "light", "driver"]

KEYS: Final = ("left", "right", "up", "down")
DRIVERS: Final = ("built-in", "keyboard")
MOST_BYTES: Final = 512


@dataclass(frozen=True)
class Order:
    """One message of a browser, checked."""

    kind: Kind
    value: str | int | bool | frozenset[str] = True


class BadOrder(UserError):
    """A message that no page of ours sends."""


def parse(text: str) -> Order:
    """The order in a message {KIND: VALUE}. Raises BadOrder for anything else."""
    try:
        message = json.loads(text) if len(text) <= MOST_BYTES else None
    except (ValueError, RecursionError):
        message = None
    if not isinstance(message, dict) or len(message) != 1:
        raise BadOrder('expected one JSON object such as {"view": "chase"}')
    ((kind, value),) = message.items()
    if kind == "got" and isinstance(value, int) and not isinstance(value, bool):
        return Order("got", value)
    if kind == "view" and value in VIEWS:
        return Order("view", value)
    if kind == "light" and value in KINDS:
        return Order("light", value)
    if kind == "driver" and value in DRIVERS:
        return Order("driver", value)
    if kind == "pause" and isinstance(value, bool):
        return Order("pause", value)
    if kind == "reset" and value is True:
        return Order("reset")
    if kind == "keys" and isinstance(value, list) and all(key in KEYS for key in value):
        return Order("keys", frozenset(value))
    raise BadOrder(f"{kind!r} with {value!r} is not understood")
