"""The keys of the label page in node, with a fake page and a fake server (`fake_page.js`)."""

import json
import shutil
import subprocess
from pathlib import Path
from typing import Any

import pytest

from mtlnet.label.server import PAGE

pytestmark = pytest.mark.skipif(shutil.which("node") is None, reason="no node")


def press(labelled: str, keys: str) -> dict[str, Any]:
    """Press `keys` on a page of four pictures; returns the state of the page and of the server."""
    script = Path(__file__).with_name("fake_page.js")
    command = ["node", str(script), str(PAGE / "label.js"), labelled, keys]
    done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=60)
    found: dict[str, Any] = json.loads(done.stdout)
    assert found["labelled"] == found["stored"]
    return found


@pytest.mark.parametrize(
    ("labelled", "keys", "received", "number"),
    [
        # A key that is pressed during a save does not change what is saved.
        ("0", "show 0,Enter,ArrowRight", ["PUT 0 -1 left"], 1),
        ("0", "show 0,drag,Enter,ArrowRight", ["PUT 0 -1.77 left"], 1),
        ("", "Enter,Enter", ["PUT 0 -1 "], 1),
        ("", "Enter,ArrowRight", ["PUT 0 -1 "], 1),
        ("", "Enter,3", ["PUT 0 -1 "], 1),
        ("", "Enter,ArrowRight,.,u", ["PUT 0 -1 ", "UNDO 0"], 0),
        ("", "Enter,.,Enter", ["PUT 0 -1 ", "PUT 1 -1.1 "], 2),
        # A class that follows from the lines is derived again, unless a key sets it.
        ("0s", "show 0,drag,Enter", ["PUT 0 -1.77 "], 1),
        ("0s", "show 0,2,drag,Enter", ["PUT 0 -1.77 straight"], 1),
        # The same holds for an undo and a removal.
        ("", "Enter,.,u,ArrowRight", ["PUT 0 -1 ", "UNDO 0"], 0),
        ("", "Enter,.,u,u", ["PUT 0 -1 ", "UNDO 0"], 0),
        ("0,1", "show 0,x,ArrowRight", ["DELETE 0"], 0),
        ("0,1", "show 0,x,x", ["DELETE 0"], 0),
        # An undo restores what the server had, also the label of a picture without a lane.
        ("0", "show 0,Enter,.,u", ["PUT 0 -1 left", "UNDO 0"], 0),
        ("0", "show 0,x,.,Enter,.,u,.,u", ["DELETE 0", "PUT 0 -1 ", "UNDO 0", "UNDO 0"], 0),
        ("0-", "show 0,x,.,u", ["DELETE 0", "UNDO 0"], 0),
        # The class of a label without a lane is shown, as that of any other label.
        ("0-", "show 0,Enter,.,u", ["PUT 0 -1 left", "UNDO 0"], 0),
        ("0-", "show 0,x,.,u,.,x,.,u", ["DELETE 0", "UNDO 0", "DELETE 0", "UNDO 0"], 0),
        # A picture that is not shown yet is not labelled, and its label is not removed.
        ("", "ArrowRight,Enter", [], 1),
        ("", "drag,ArrowRight,Enter", [], 1),
        ("0,1", "show 0,ArrowRight,x", [], 1),
        ("", "ArrowRight,ArrowRight", [], 2),
    ],
)
def test_a_key_acts_on_the_picture_that_was_shown(
    labelled: str, keys: str, received: list[str], number: int
) -> None:
    found = press(labelled, keys)
    assert found["received"] == received
    assert (found["number"], found["shown"]) == (number, f"{number}.png")


CONFLICT = "changed since it was shown"


@pytest.mark.parametrize(
    ("labelled", "keys", "received", "shown"),
    [
        # Picture 1 was fetched in advance; then another page labels it or removes its label.
        ("", "other 1,ArrowRight,.,Enter", [], "1.png"),
        ("", "other 1,ArrowRight,.,x", [], "1.png"),
        ("1", "show 0,.,other 1,ArrowRight,.,x", [], "1.png"),
        ("", "other 1,ArrowRight,.,Enter,.,u", [], "1.png"),
        # Another page changes a label that this page has saved.
        ("", "Enter,.,other 0,u", ["PUT 0 -1 "], "0.png"),
        ("", "Enter,.,Enter,.,other 1,u", ["PUT 0 -1 ", "PUT 1 -1.1 "], "1.png"),
    ],
)
def test_the_label_of_another_page_is_shown_and_not_overwritten(
    labelled: str, keys: str, received: list[str], shown: str
) -> None:
    found = press(labelled, keys)
    assert (found["received"], found["shown"]) == (received, shown)
    assert CONFLICT in found["status"] or keys.endswith("Enter,.,u")


def test_after_a_conflict_the_present_label_can_be_changed() -> None:
    found = press("", "other 1,ArrowRight,.,Enter,.,Enter,.,u")
    assert found["received"] == ["PUT 1 -1.1 left", "UNDO 1"]
    # The undo that is refused does not block the undo of earlier changes.
    found = press("", "Enter,.,Enter,.,other 1,u,.,u")
    assert found["received"] == ["PUT 0 -1 ", "PUT 1 -1.1 ", "UNDO 0"]
    # A label that another page has saved can be removed by the next key.
    assert press("", "other 1,ArrowRight,.,x,.,x")["received"] == ["DELETE 1"]


def test_a_saving_without_changes_is_one_step_of_undo() -> None:
    found = press("", "Enter,.,ArrowLeft,.,Enter,.,u,.,u")
    assert found["received"] == ["PUT 0 -1 ", "PUT 0 -1 left", "UNDO 0", "UNDO 0"]
    assert found["stored"][0] is False
    # Where no label is to remove, nothing is to be undone.
    assert press("", "Enter,.,x,.,u")["received"] == ["PUT 0 -1 ", "UNDO 0"]


def test_a_failed_request_is_shown_and_can_be_repeated() -> None:
    found = press("0", "show 0,fail,Enter")
    assert (found["received"], found["status"], found["number"]) == ([], "no answer", 0)
    found = press("", "Enter,.,fail,u")
    assert (found["received"], found["status"]) == (["PUT 0 -1 "], "no answer")
    found = press("", "Enter,.,fail,u,.,u")
    assert found["received"] == ["PUT 0 -1 ", "UNDO 0"]


@pytest.mark.parametrize(
    ("labelled", "keys", "drives", "shown"),
    [
        # A look at a labelled picture, or its saving, does not change what was typed.
        ("0", "type drive b,.,show 0,.,show 1,.,Enter,.", ["old", "b"], "b"),
        ("0", "type drive b,.,show 0,.,Enter,.,Enter,.", ["old", "b", None, None], "b"),
        ("0", "show 0,.,type drive c,Enter,.,Enter,.", ["c", "", None, None], ""),
        # What was typed is shown again after a reload, also if nothing was saved.
        ("", "type drive b,.,reload,.,Enter,.", ["b", None, None, None], "b"),
        ("0", ".,type drive b,show 0,.,reload,.,Enter,.", ["old", "b", None, None], "b"),
        ("", "type drive b,.,Enter,.,type drive b2,Enter,.,u,.,reload,.", ["b", "b2"], "b2"),
        # An emptied field stays empty.
        ("", ".,type drive b,Enter,.,type drive ,reload,.,Enter,.", ["b", "", None, None], ""),
    ],
)
def test_the_typed_drive_stays_for_the_next_pictures_without_a_label(
    labelled: str, keys: str, drives: list[str | None], shown: str
) -> None:
    found = press(labelled, keys)
    assert (found["drives"][: len(drives)], found["drive"]) == (drives, shown)
