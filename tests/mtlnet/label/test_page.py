"""The label page in a browser: handles dragged with the mouse, keys, and what is saved."""

import json
from pathlib import Path

import numpy as np
import pytest

from mtlnet.data.labels_file import read_labels
from mtlnet.label.geometry import marking_pixels
from tests.browser import CHROMIUM, MISSING, Browser, open_browser
from tests.mtlnet.label.conftest import TRUE, Site
from trackfeatures.camera import CameraParameters

pytestmark = [
    pytest.mark.extended,
    pytest.mark.skipif(CHROMIUM is None, reason=MISSING),
]
VIEW = CameraParameters(width=640, height=360, fov_y_deg=40, x=0.0, z=0.97)


def drag_onto_markings(browser: Browser) -> None:
    """Drag all four round handles onto the drawn markings."""
    targets = dict(zip(("left", "right"), marking_pixels(VIEW, TRUE, [6.0, 25.0]), strict=True))
    for side, which, target in (
        ("left", 0, 0),
        ("right", 0, 0),
        ("left", 2, 1),
        ("right", 2, 1),
    ):
        box = browser.evaluate(
            "(() => { const b = document.getElementById('picture').getBoundingClientRect(); "
            "return [b.left, b.top, b.width / 640]; })()"
        )
        shown = browser.evaluate("document.getElementById('picture').dataset.handles")
        start = np.array(json.loads(shown)[side][which])
        places = [
            tuple(((at + 0.5) * box[2] + box[:2]).tolist()) for at in (start, targets[side][target])
        ]
        browser.drag(places[0], places[1])
        browser.wait("!document.body.dataset.busy")
        assert browser.evaluate("document.getElementById('status').textContent") == ""


@pytest.mark.parametrize(("width", "height"), [(1280, 900), (390, 800)])
def test_pictures_are_labelled_by_mouse_and_keys(
    site: Site, tmp_path: Path, width: int, height: int
) -> None:
    table = site.folder / "labels.csv"
    with open_browser(tmp_path / "p", width, height) as browser:
        browser.open(f"http://127.0.0.1:{site.port}/")
        browser.wait("document.body.dataset.ready === '0'")
        drag_onto_markings(browser)
        browser.press("Enter")
        browser.wait("document.body.dataset.ready === '1'")
        # A handle moves with the mouse, in whole pixels of the screen.
        [picture], labels = read_labels(table)
        assert picture.file == "1.png"
        tolerance = 0.02 if width > 600 else 0.05
        np.testing.assert_allclose(labels.distances[0, :2], [-1.5, 2.1], atol=tolerance)
        assert labels.angle[0] == pytest.approx(0.03, abs=0.003)
        assert picture.pitch_deg == pytest.approx(0.5, abs=0.1)
        drag_onto_markings(browser)
        browser.press("3")
        browser.press("n")
        browser.wait("document.body.dataset.ready === '2'")
        _, labels = read_labels(table)
        assert labels.heading.tolist() == [1, 2]
        # Undo removes the last label, then the one before.
        browser.press("u")
        browser.wait("document.body.dataset.ready === '1'")
        assert [p.file for p in read_labels(table)[0]] == ["1.png"]
        browser.press("u")
        browser.wait("document.body.dataset.ready === '0'")
        assert not table.exists()


def test_undo_restores_a_label_without_a_lane_and_a_second_page_keeps_a_label(
    site: Site, tmp_path: Path
) -> None:
    table = site.folder / "labels.csv"
    text = "file,ml,mr,l,m,r,angle,heading,drive\n1.png,,,,,,0.01,straight,city\n"
    table.write_text(text)
    url, status = f"http://127.0.0.1:{site.port}/", "document.getElementById('status').textContent"
    with open_browser(tmp_path / "a", 800, 700) as a, open_browser(tmp_path / "b", 800, 700) as b:
        for browser in (a, b):
            browser.open(url)
            browser.wait("document.body.dataset.ready === '1'")
        b.press("ArrowLeft")
        b.wait("document.body.dataset.ready === '0'")
        b.press("Enter")
        b.wait("document.body.dataset.ready === '1'")
        assert table.read_text() != text
        b.press("u")
        b.wait("document.body.dataset.ready === '0'")
        assert table.read_text() == text
        # Page b has fetched picture 1 before page a saves its label.
        a.press("Enter")
        a.wait("document.body.dataset.ready === '2'")
        saved = table.read_text()
        b.press("ArrowRight")
        b.wait("document.body.dataset.ready === '1'")
        b.press("Enter")
        b.wait(f"{status}.includes('has changed since it was shown')")
        assert table.read_text() == saved
        assert "✓" in b.evaluate("document.getElementById('name').textContent")


def test_the_page_asks_for_the_token(guarded: Site, tmp_path: Path) -> None:
    url = f"http://127.0.0.1:{guarded.port}/"
    with open_browser(tmp_path / "p", 800, 700) as browser:
        browser.open(url)
        browser.wait("document.getElementById('locked').hidden === false")
        browser.evaluate(
            "(() => { const t = document.getElementById('token'); "
            "t.value = 'a-token-of-sixteen'; t.dispatchEvent(new Event('change')); })()"
        )
        browser.wait("document.body.dataset.ready === '0'")
        assert browser.evaluate("document.getElementById('locked').hidden") is True
    with open_browser(tmp_path / "q", 800, 700) as browser:
        browser.open(url + "#a-token-of-sixteen")
        browser.wait("document.body.dataset.ready === '0'")
        assert browser.evaluate("location.hash") == ""
