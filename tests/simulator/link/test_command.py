"""Options of `simulator link`: bad ones are refused in one line."""

import math
from pathlib import Path
from typing import Any

import pytest

from simulator.link.command import picture_size
from simulator.link.config import LinkConfig
from simulator.link.process import run
from trackfeatures.errors import UserError


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"name": "/" + "x" * 300}, "has 301 bytes"),
        ({"track": "no-such-track"}, "no track 'no-such-track'"),
        ({"frequency_hz": 30}, "30 Hz does not divide"),
        ({"frequency_hz": 0}, "0 Hz does not divide"),
        ({"lanes": 4}, "4"),
        ({"lane_width": 9.0}, "9"),
        ({"picture": (9999, 10)}, "9999 x 10"),
        ({"picture": (64, 48), "light": "noon"}, "unknown light 'noon'"),
        ({"patience_s": -1.0}, "--patience is -1"),
        ({"patience_s": math.nan}, "--patience is nan"),
        ({"tracks_dir": Path("/no/such/folder")}, "/no/such/folder"),
    ],
    ids=str,
)
def test_bad_server_options_are_refused(name: str, options: dict[str, Any], said: str) -> None:
    with pytest.raises(UserError, match=said):
        run(LinkConfig(**{"name": name, **options}), lambda text: None)


@pytest.mark.parametrize("text", ["280", "0x10", "10x0", "ax10", "10x10x3", "-3x4", ""])
def test_bad_image_sizes_are_refused(text: str) -> None:
    with pytest.raises(UserError, match="give a size such as 280x210, or none"):
        picture_size(text)
    assert (picture_size("280x210"), picture_size("none")) == ((280, 210), (0, 0))
