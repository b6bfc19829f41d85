"""The console: its files, its samples, and its behaviour in a real browser."""

import json
import math
import re
import shutil
import subprocess
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from serve.api.console import FOLDER
from tests.browser import CHROMIUM, MISSING, Browser, open_browser
from tests.serve.conftest import Served
from trackfeatures.camera import CameraParameters

ANSWER = "0.00 m left of the lane's centre, pointing 5.7° to the right."
"""The sentence of the page for the fake model's answer."""
PICTURE = "document.getElementById('picture')"
STATUS = "document.getElementById('status').textContent"
COUNT = "Number(/over (\\d+)/.exec(document.getElementById('times').textContent)?.[1] ?? 0)"
"""JavaScript expression: the number of requests in the page's latency statistics."""


def test_the_page_loads_files_of_the_service_only(service: Served) -> None:
    page = service.ask("GET", "/")
    assert page.status == 200
    assert page.headers["content-type"].startswith("text/html")
    assert "default-src 'none'" in page.headers["content-security-policy"]
    text = page.content.decode()
    for path in re.findall(r'(?:href|src)="(console/[^"]+)"', text):
        assert service.ask("GET", f"/{path}").status == 200
    for file in (*FOLDER.glob("*.html"), *FOLDER.glob("*.css"), *FOLDER.glob("*.js")):
        assert set(re.findall(r"https?://[^/\s<]+", file.read_text())) <= {"http://127.0.0.1:8000"}
    assert service.ask("GET", "/console/../app.py").status == 404
    assert service.ask("GET", "/console/no-such.js").status == 404


def test_every_sample_has_the_models_size_and_true_features(service: Served) -> None:
    samples = service.ask("GET", "/console/samples.json").content
    assert len(samples) >= 6
    camera = CameraParameters()
    for sample in samples:
        body = service.ask("GET", f"/console/{sample['file']}").content
        image = cv2.imdecode(np.frombuffer(body, np.uint8), cv2.IMREAD_COLOR)
        assert image is not None
        assert image.shape == (camera.height, camera.width, 3)
        truth = sample["truth"]
        ml, mr = truth["distances_m"]["ml"], truth["distances_m"]["mr"]
        if ml is not None:
            assert truth["to_lane_centre_m"] == pytest.approx((ml + mr) / 2, abs=2e-4)
        assert abs(truth["angle_rad"]) < 0.3
        assert service.post(body).status == 200


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    with open_browser(tmp_path_factory.mktemp("profile"), 1360, 1000) as found:
        yield found


@pytest.mark.slow
@pytest.mark.skipif(CHROMIUM is None, reason=MISSING)
def test_a_browser_shows_the_answer(service: Served, browser: Browser, tmp_path: Path) -> None:
    """The page sends its first sample without user input."""
    browser.open(service.url)
    browser.wait(f"{COUNT} === 1")
    assert browser.evaluate(STATUS) == ANSWER
    text = " ".join(browser.evaluate("document.body.textContent").split())
    assert "ml-2.00 m" in text
    assert "mr2.00 m" in text
    assert "straight50 %" in text
    # The markings of the car's lane are drawn in their blue.
    shot = tmp_path / "console.png"
    browser.screenshot(shot)
    picture = cv2.imread(str(shot))
    assert picture is not None
    assert picture.shape == (1000, 1360, 3)
    blue = np.abs(picture.astype(int) - (214, 132, 10)).sum(axis=2) < 60
    assert blue[:, :900].sum() > 800


def green_share(browser: Browser) -> float:
    """Fraction of the shown picture with the green of the fake webcam."""
    pixels = browser.evaluate(
        f"[...{PICTURE}.getContext('2d').getImageData(0, 0, {PICTURE}.width, 60).data]"
    )
    colours = np.array(pixels).reshape(-1, 4)
    return float(np.mean((colours[:, 1] > 150) & (colours[:, 0] < 100) & (colours[:, 2] < 120)))


@pytest.mark.slow
@pytest.mark.skipif(CHROMIUM is None, reason=MISSING)
def test_a_webcam_is_answered_picture_by_picture(service: Served, browser: Browser) -> None:
    browser.open(service.url)
    browser.wait(f"{COUNT} === 1")  # the answer for the first sample
    browser.evaluate("document.getElementById('webcam').click()")
    browser.wait(f"{COUNT} >= 6")
    assert browser.evaluate(STATUS) == ANSWER
    size = browser.evaluate(f"{PICTURE}.width / {PICTURE}.height")
    video = "document.getElementById('video')"
    camera = browser.evaluate(f"{video}.videoWidth / {video}.videoHeight")
    assert size == pytest.approx(camera, abs=0.01)
    assert green_share(browser) > 0.1
    browser.evaluate("document.getElementById('stop').click()")
    browser.wait("document.getElementById('stop').hidden")
    assert not browser.evaluate("document.getElementById('webcam').hidden")
    assert browser.evaluate(f"{video}.srcObject") is None


@pytest.mark.slow
@pytest.mark.skipif(CHROMIUM is None, reason=MISSING)
def test_a_film_is_answered_while_it_plays(
    service: Served, browser: Browser, tmp_path: Path
) -> None:
    film = tmp_path / "green.webm"
    writer = cv2.VideoWriter(str(film), cv2.VideoWriter.fourcc(*"VP80"), 20.0, (640, 480))
    for _ in range(20):
        writer.write(np.full((480, 640, 3), (40, 200, 40), np.uint8))
    writer.release()
    browser.open(service.url)
    browser.wait(f"{COUNT} === 1")
    browser.choose_file("#file", film)
    browser.wait(f"{COUNT} >= 4")
    browser.wait("document.getElementById('stop').hidden")  # the film has ended
    assert green_share(browser) > 0.9
    (tmp_path / "none.webm").write_bytes(b"no film")
    browser.choose_file("#file", tmp_path / "none.webm")
    text = browser.wait("document.querySelector('#status.bad')?.textContent")
    assert text.startswith("the browser cannot play this film: ")


needs_node = pytest.mark.skipif(shutil.which("node") is None, reason="no node")


def node(folder: Path, module: str, names: str, script: str) -> Any:
    """The value of the last expression of `script`, which imports `names` from a file of the
    console."""
    file = folder / "ask.mjs"
    file.write_text(
        f"import {{ {names} }} from '{(FOLDER / module).as_uri()}';\n"
        f"const found = {script};\nconsole.log(JSON.stringify(found));\n"
    )
    done = subprocess.run(["node", str(file)], capture_output=True, text=True, check=True)
    return json.loads(done.stdout)


@needs_node
def test_a_marking_is_absent_where_the_service_says_so(tmp_path: Path) -> None:
    """`l` is present up to a probability of absence of 0.75."""
    answer = {
        "distances_m": {"ml": None, "l": -3.5},
        "absent": {"ml": 0.9, "l": 0.7},
    }
    coded = {**answer, "absent": None}
    asked = [(answer, "ml"), (answer, "l"), (answer, "angle"), (coded, "ml")]
    script = f"{json.dumps(asked)}.map((each) => absence(...each))"
    found = node(tmp_path, "drawing.js", "absence", script)
    assert found == ["absent, 90 %", None, None, None]


@needs_node
def test_console_geometry_equals_the_pinhole_camera(tmp_path: Path) -> None:
    """A point on a marking is drawn where the camera matrix projects it: 2 m right, 5 m ahead."""
    camera = json.dumps(asdict(CameraParameters()))
    script = (
        f"[project(onMarking(2, 0, 5.75), {camera}), onMarking(2, 0.1, 0), onMarking(0, 0.1, 10)]"
    )
    pixel, beside, ahead = node(tmp_path, "geometry.js", "onMarking, project", script)
    focal = 105 / math.tan(math.radians(67.5) / 2)
    assert pixel == pytest.approx([140 + focal * 2 / 5, 105 + focal * 1.2 / 5])
    assert beside == pytest.approx([2 * math.sin(0.1), -2 * math.cos(0.1)])
    assert ahead == pytest.approx([10 * math.cos(0.1), 10 * math.sin(0.1)])


@needs_node
def test_console_geometry_equals_the_projection_of_any_camera(tmp_path: Path) -> None:
    mount = {"x": 1.2, "y": 0.1, "z": 1.1, "pitch_deg": 5.0, "roll_deg": 3.0, "yaw_deg": -4.0}
    matrix = (700.0, 720.0, 655.0, 340.0)
    lenses: list[tuple[str, tuple[float, ...]]] = [
        ("none", ()),
        ("opencv", (-0.3, 0.1, 0.001, -0.002)),
        ("opencv", (0.9, 0.3, 0.0003, -0.0004, 0.02, 1.2, 0.5, 0.05)),
        ("fisheye", (-0.02, 0.005, -0.003, 0.0006)),
        ("opencv", (-0.5, 0.0, 0.0, 0.0)),  # a lens model that folds
    ]
    cameras = [
        CameraParameters(1280, 720, matrix=matrix, distortion=kind, coefficients=k, **mount)
        for kind, k in lenses
    ]
    places = [(4.0, -2.5), (8.0, 1.5), (30.0, -4.0), (-3.0, 0.0), (2.4, 2.4)]
    script = (
        f"{json.dumps([camera.as_dict() for camera in cameras])}.map((camera) =>"
        f" {json.dumps(places)}.map((place) => project(place, camera)))"
    )
    pixels = node(tmp_path, "geometry.js", "project", script)
    unseen = 0
    for camera, found in zip(cameras, pixels, strict=True):
        expected = camera.project([(*place, -camera.cg_height_m) for place in places]) + 0.5
        for pixel, wanted in zip(found, expected.tolist(), strict=True):
            assert (pixel is None) == math.isnan(wanted[0])
            unseen += pixel is None
            if pixel is not None:
                assert pixel == pytest.approx(wanted, abs=1e-6)
    assert unseen >= 6


PAGE = """
const made = {}, listeners = {};
const element = (id) => made[id] ??= {
  style: {}, dataset: {}, hidden: true, value: "", children: [], classList: { toggle() {} },
  addEventListener(event, action) { listeners[`${id} ${event}`] = action; },
  append() {}, replaceChildren() {}, setAttribute() {}, dispatchEvent() {},
  getContext: () => new Proxy({}, { get: () => () => {} }),
};
globalThis.document = {
  getElementById: element, querySelector: element,
  createElement: () => element(Math.random()), documentElement: { dataset: {} },
};
globalThis.location = { origin: "http://service" };
globalThis.setInterval = () => {};
const camera = { width: 280, height: 210, fov_y_deg: 67.5 };
const card = { model: "ab".repeat(32), engine: "fake", precision: "f32", camera, cameras: {} };
globalThis.fetch = async (path, options = {}) => {
  if (path !== "model") return { status: 200, ok: true, json: async () => [] };
  const ok = options.headers?.Authorization === "Bearer right";
  return { status: ok ? 200 : 401, ok, json: async () => (ok ? card : { detail: "no token" }) };
};
await import(process.argv[2]);
const shown = () => [element("locked").hidden, element("model").textContent];
const before = shown();
const entered = async (token) => {
  element("token").value = token;
  await listeners["token change"]();
  return shown();
};
console.log(JSON.stringify([before, await entered("wrong"), await entered("right")]));
"""
"""A script for node: the console on a fake page of a service with the token `right`."""


@needs_node
def test_the_page_of_a_service_with_a_token_asks_for_it(tmp_path: Path) -> None:
    file = tmp_path / "page.mjs"
    file.write_text(PAGE)
    words = ["node", str(file), (FOLDER / "console.js").as_uri()]
    done = subprocess.run(words, capture_output=True, text=True, check=True)
    before, refused, after = json.loads(done.stdout)
    assert before == [False, "enter the service's token below the picture"]
    assert refused == [False, "the service has another token"]
    assert after[1].startswith("model abababababab, fake f32, camera 280 ")
