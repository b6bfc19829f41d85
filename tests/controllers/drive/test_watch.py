"""`controllers drive --watch`: the page of `simulator watch` during a controller's drive."""

import json
import re
import subprocess
import sys
import time
from contextlib import suppress
from typing import Any

import pytest
import simplejpeg
from websockets.exceptions import ConnectionClosed

from simulator.watch.pictures import SIZE
from tests.simulator.watch.test_drive import Page

STEPS = 160


def test_a_drive_is_shown_live_and_the_page_ends_with_it() -> None:
    command = [sys.executable, "-m", "controllers", "drive", "--controller", "lqr", "--json"]
    options = ["--watch", "0", "--steps", str(STEPS), "--lanes", "2", "--target-lane", "0"]
    began = time.monotonic()
    process = subprocess.Popen(
        [*command, *options], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    states: list[dict[str, Any]] = []
    pictures: list[bytes] = []
    try:
        assert process.stderr is not None
        found = next(
            filter(None, (re.search(r"http://127.*:(\d+)", row) for row in process.stderr))
        )
        with Page(int(found[1])) as page:
            assert (page.scene["track"], page.scene["controls"]) == ("oval", False)
            page.ask(view="top")
            with suppress(ConnectionClosed):  # the page ends with the drive, which ends the loop
                while True:
                    data = page.line.recv(timeout=120)
                    if isinstance(data, bytes):
                        pictures.append(data)
                        continue
                    states.append(json.loads(data))
                    page.ask(got=states[-1]["number"])
        out, _ = process.communicate(timeout=120)
    finally:
        process.kill()
        process.wait()
    assert process.returncode == 0
    assert json.loads(out)["steps"] == STEPS
    assert time.monotonic() - began > 0.9 * STEPS / 20  # at its real pace
    assert simplejpeg.decode_jpeg(pictures[-1]).shape == (SIZE[1], SIZE[0], 3)
    assert states[-1]["driver"] == "program"
    # On the truth the perceived road is the state: the centre of the left lane.
    assert states[-1]["perceived"] == {
        "to_middle": states[-1]["to_middle"],
        "angle": states[-1]["angle"],
    }
    assert states[-1]["to_middle"] == pytest.approx(2.0, abs=0.2)
    assert states[-1]["time_s"] > states[0]["time_s"]
