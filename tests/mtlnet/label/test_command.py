"""`mtlnet label` as it is typed, and the model's answer with which a picture begins."""

import json
import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

import trackfeatures as tf
from mtlnet.data.labels_file import read_labels
from mtlnet.label.folder import LabelFolder
from mtlnet.label.server import Labeller
from runtime.files import locked_folder
from tests.mtlnet.label.conftest import Site
from tests.mtlnet.label.test_import import HEAD, table
from tests.mtlnet.test_cli import mtlnet, refused
from tests.typed import typed
from trackfeatures.camera import CameraParameters


class FakeEngine:
    """Answers what it is told, in metres beside the model's camera."""

    def __init__(self, distances: list[float], angle: float) -> None:
        self.card = SimpleNamespace(camera=CameraParameters())
        self._coded = tf.encode([distances], [angle])[0]

    def __call__(self, image: NDArray[np.uint8]) -> NDArray[np.float32]:
        assert image.shape == (210, 280, 3)
        return np.concatenate([self._coded, [0.1, 0.8, 0.1]]).astype(np.float32)


def first(pictures: Path, engine: Any) -> dict[str, Any]:
    folder = LabelFolder(pictures, None, CameraParameters())
    return Labeller(folder, engine).picture(0)


def test_a_picture_begins_with_the_models_answer(pictures: Path) -> None:
    nan = np.nan
    shown = first(pictures, FakeEngine([-1.2, 2.4, nan, nan, nan], 0.02))
    assert (shown["source"], shown["note"]) == ("model", "")
    scale, aside = 1.22 / 1.2, 0.75 * np.sin(0.02)  # of the heights; the model's camera is ahead
    assert shown["markings"]["ml"] == pytest.approx(scale * (-1.2 - aside), abs=1e-3)
    assert shown["markings"]["mr"] == pytest.approx(scale * (2.4 - aside), abs=1e-3)
    assert shown["markings"]["angle"] == pytest.approx(0.02, abs=1e-5)
    on_marking = first(pictures, FakeEngine([nan, nan, -4.0, -0.2, 3.6], 0.0))
    assert on_marking["markings"]["mr"] == pytest.approx(scale * 3.6, abs=1e-3)
    nothing = first(pictures, FakeEngine([nan] * 5, 0.0))
    assert (nothing["source"], nothing["note"]) == ("usual", "the model sees no lane")
    (pictures / "camera.yaml").write_text("{width: 640, height: 360, fov_y_deg: 3}\n")
    narrow = first(pictures, FakeEngine([nan] * 5, 0.0))
    assert narrow["source"] == "usual"
    assert "the image shows" in narrow["note"]


@pytest.fixture
def hangup() -> Iterator[None]:
    """SIGHUP has its default action; tests started by `nohup` inherit that it is ignored."""
    before = signal.signal(signal.SIGHUP, signal.SIG_DFL)
    yield
    signal.signal(signal.SIGHUP, before)


@pytest.mark.usefixtures("hangup")
@pytest.mark.parametrize("names", ["SIGINT", "SIGTERM", "SIGHUP", "SIGINT SIGINT"])
def test_the_command_serves_and_ends_with_a_signal(pictures: Path, names: str) -> None:
    command = [sys.executable, "-m", "mtlnet", "label", str(pictures), "--no-model", "--port", "0"]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as process:
        try:
            assert process.stderr is not None
            line = process.stderr.readline()
            found = re.search(r"3 pictures; open http://127\.0\.0\.1:(\d+)/ ", line)
            assert found is not None, line
            assert Site(pictures, int(found[1])).ask("GET", "/api/pictures")[0] == 200
            assert "another process is writing to" in refused("label", pictures, "--no-model")
        finally:
            for name in names.split():
                process.send_signal(signal.Signals[name])
                time.sleep(0.02)  # so that two signals are not one
        rest = process.stderr.read()
    assert process.returncode in (0, 130), rest
    assert "Traceback" not in rest


def test_the_assumed_mount_of_a_camera_file_is_printed(pictures: Path) -> None:
    (pictures / "camera.yaml").unlink()
    camera = pictures.parent / "ros.yaml"
    matrix = "[500, 0, 320, 0, 500, 180, 0, 0, 1]"
    camera.write_text(
        f"{{image_width: 640, image_height: 360, camera_matrix: {{data: {matrix}}}, "
        "distortion_model: plumb_bob, distortion_coefficients: {data: [0, 0, 0, 0, 0]}}\n"
    )
    with locked_folder(pictures):  # the command ends when it has read the camera
        done = mtlnet("label", pictures, "--no-model", "--camera", camera)
    note, error = done.stderr.splitlines()
    assert note.startswith(
        f"{camera}: a calibration of OpenCV or ROS; no mount is given, so 1.2 m above the road and "
        "pitch 0 deg are assumed"
    )
    assert "another process is writing to" in error


def test_mistakes_are_one_line(pictures: Path, tmp_path: Path) -> None:
    seen = refused("label", pictures, "--no-model", "--host", "0.0.0.0")
    assert "--host 0.0.0.0 can be reached from other machines: set a token" in seen
    assert "--label-std belongs to --import" in refused("label", pictures, "--label-std", "1,1")
    assert "--json belongs to --import" in refused("label", tmp_path / "none", "--json")
    both = refused("label", pictures, "--import", "table.csv", "--camera", "camera.yaml")
    assert "--import takes the cameras from its table; leave --camera out" in both
    assert "there is no folder" in refused("label", tmp_path / "none", "--no-model")


@pytest.mark.parametrize(
    ("options", "named"),
    [
        (("--host", "127.0.0.1"), "--host"),
        (("--port", "8010"), "--port"),
        (("--token-file", "token"), "--token-file"),
        (("--insecure", "--no-model", "--model", "default"), "--model, --no-model, --insecure"),
    ],
)
def test_options_of_the_page_are_refused_with_import(
    tmp_path: Path, options: tuple[str, ...], named: str
) -> None:
    path = table(tmp_path / "theirs", "a.png,1.7,-1.9,0.03,40,1.22", head=HEAD)
    seen = refused("label", tmp_path / "mine", "--import", path, *options)
    assert seen == f"error: --import does not open the page; leave {named} out"
    assert not (tmp_path / "mine").exists()


def test_a_table_is_imported_by_the_command(tmp_path: Path) -> None:
    rows = ("a.png,1.7,-1.9,0.03,40,1.22", "b.png,1.6,-2.0,0.02,40,1.22")
    path = table(tmp_path / "theirs", *rows, head=HEAD)
    done = typed(
        *("mtlnet", "label", tmp_path / "mine", "--import", path, "--json"),
        *("--label-std", "0.06,0.006", "--label-std", "b*=0.1,0.01"),
    )
    assert json.loads(done.stdout)["pictures"] == 2
    pictures, _ = read_labels(tmp_path / "mine" / "labels.csv")
    assert [(p.std_m, p.std_rad) for p in pictures] == [(0.06, 0.006), (0.1, 0.01)]


def test_the_label_of_a_picture_survives_another_size(pictures: Path) -> None:
    """The camera's file may be of another size than the pictures."""
    (pictures / "camera.yaml").write_text(
        "{width: 1280, height: 720, fov_y_deg: 40, x: 0.0, height_above_road_m: 1.22}\n"
    )
    folder = LabelFolder(pictures, None, CameraParameters())
    camera = folder.camera(0, 640, 360)
    same = CameraParameters(width=640, height=360, fov_y_deg=40, x=0.0, z=0.97)
    assert replace(camera, z=0.97) == same
