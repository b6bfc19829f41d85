"""The page "What is refused, and why": each of its rows is tried, with its class and message."""

import copy
import os
import re
import subprocess
import sys
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any
from unittest import mock

import gymnasium as gym
import numpy as np
import pytest
import simplejpeg

import simulator.env  # noqa: F401  # registers the environments
from controllers.rl.config import TrainConfig
from controllers.rl.run_folder import stored_config
from controllers.rl.training import train as train_actor
from datagen.recording import Dataset
from datagen.recording.mcap.footer import read_summary
from datagen.recording.mcap.index import open_round
from docs.generate import error_classes
from mtlnet.calibration.config import CalibrateConfig
from mtlnet.calibration.run import calibrate
from mtlnet.data.custom_images import COLUMNS, open_custom_images
from mtlnet.evaluation.protocol import drive_rows
from mtlnet.inference.engine import Engine, load_engine
from mtlnet.inference.image_decoding.decode import inspect, read_image
from mtlnet.inference.model_card import resolve_run
from mtlnet.inference.rectification import Rectification
from mtlnet.label.folder import LabelFolder
from mtlnet.label.geometry import fit_markings
from mtlnet.label.import_table import import_labels
from mtlnet.predict.run import predict_files
from mtlnet.sources.films import Film, read_film_header
from mtlnet.training.losses.alpha import parse_alpha
from runtime.camera_file import read_camera
from serve.cameras import read_cameras
from simulator.camera.core.context import Graphics
from simulator.camera.core.turns import Turns
from simulator.env.vector import DriverViewVector, LateralControlVector
from simulator.track.catalogue import find_track
from simulator.track.road import Road
from simulator.track.torcs.torcs import read_torcs
from simulator.varied.road import make_road
from simulator.vehicle.state import Command
from simulator.world.world import World
from tests.mtlnet.conftest import write_dataset
from tests.mtlnet.sources import recorded
from trackfeatures.camera import CameraParameters
from trackfeatures.errors import UserError

PAGE = (Path(__file__).parents[2] / "docs" / "reference" / "errors.md").read_text()
ROWS = [
    [cell.strip().strip("`") for cell in line.strip("|").split("|")]
    for line in PAGE.splitlines()
    if line.startswith("| ") and not line.startswith("| input")
]
VIEW = CameraParameters()
Try = Callable[[Path], object]


def jpeg(width: int = 280, height: int = 210) -> bytes:
    return bytes(simplejpeg.encode_jpeg(np.full((height, width, 3), 90, np.uint8)))


def written(folder: Path, name: str, content: bytes) -> Path:
    path = folder / name
    path.write_bytes(content)
    return path


@cache
def engine() -> Engine:
    return load_engine(resolve_run("default"))


def predict(path: Path) -> object:
    return predict_files(engine(), [str(path)])


def film(folder: Path, *arguments: str, name: str = "a.mp4") -> Path:
    """A film of 20 frames that FFmpeg makes with these arguments."""
    program = pytest.importorskip("imageio_ffmpeg").get_ffmpeg_exe()
    source = ["-f", "lavfi", "-i", "testsrc2=size=280x210:rate=10:duration=2"]
    command = [program, "-v", "error", *source, *arguments, str(folder / name)]
    subprocess.run(command, check=True, stderr=subprocess.DEVNULL)
    return folder / name


def image(folder: Path, content: bytes) -> object:
    return read_image(written(folder, "a.jpg", content), VIEW)


def camera_file(folder: Path, text: str) -> object:
    return read_camera(written(folder, "camera.yaml", text.encode()), VIEW)


SIZED = "image_width: 640\nimage_height: 480\ndist_coeffs: [0.1, 0, 0, 0]\n"
MATRIX = "camera_matrix: [[500, 0, 9], [0, 500, 9], [0, 0, 1]]\n"
GREY = recorded.ros_image(np.full((210, 280), 90, np.uint8), "mono8")
LARGE = recorded.ros_image(np.full((420, 560), 90, np.uint8), "mono8")
DEPTHS = recorded.ros_image(np.ones((210, 280), np.float32), "32FC1")
CAMERA = recorded.ros_camera((280, 210), (150, 150, 140, 105))


def bag(folder: Path, *messages: tuple[str, str, object]) -> Path:
    return recorded.write_bag(folder / "bag", list(messages))


def damaged_round(folder: Path) -> Dataset:
    data = write_dataset(folder)
    path = data / "rounds" / "r000.mcap"
    content = bytearray(path.read_bytes())
    content[read_summary(memoryview(bytes(content))).chunks[0].start + 20_000] ^= 0x10
    path.unlink()  # other tests may have mapped it
    path.write_bytes(content)
    return Dataset.open(data)


def calibrated(folder: Path, source: Path, **options: Any) -> object:
    return calibrate(CalibrateConfig([str(source)], folder / "camera.yaml", **options))


def labelled(folder: Path, ml: str, width: int) -> object:
    written(folder, "a.jpg", jpeg(width))
    rows = f"{','.join(COLUMNS)}\na.jpg,{ml},2.0,,,,0.0,straight\n"
    written(folder, "labels.csv", rows.encode())
    return open_custom_images(folder, VIEW)


def pictures_without_camera(folder: Path) -> object:
    written(folder, "a.jpg", jpeg())
    return LabelFolder(folder, None, VIEW)


def environment() -> gym.Env[object, object]:
    return gym.make("driverview/LateralControl-v0", track="oval").unwrapped


def on_oval(command: Command | None = None, **start: float) -> object:
    with World(Road(find_track("oval"))) as world:
        return [world.reset(seed=0, **start), command and world.step(command)]


def halved(path: Path) -> Path:
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    return path


TRIES: dict[str, Try] = {
    "no image, or a kind": lambda folder: image(folder, b"\0\0\0\x18ftypheic" + bytes(40)),
    "a damaged or incomplete image": lambda folder: image(folder, jpeg()[:-300]),
    "an image of under 16 px": lambda folder: image(folder, jpeg(12, 9)),
    "an image that shows less": lambda folder: image(folder, jpeg(100, 210)),
    "an image of a camera file": lambda folder: Rectification(
        CameraParameters(fov_y_deg=12.0), VIEW
    ).image(np.zeros((210, 280, 3), np.uint8)),
    "a camera file without numbers": lambda folder: camera_file(folder, SIZED + "camera_matrix:\n"),
    "a singular camera matrix": lambda folder: camera_file(
        folder, SIZED + MATRIX.replace("500", "0")
    ),
    "coefficients of another number": lambda folder: camera_file(
        folder, SIZED.replace("0, 0, 0]", "0]") + MATRIX
    ),
    "a number that is not finite": lambda folder: camera_file(
        folder, SIZED + MATRIX.replace("500", ".nan")
    ),
    "a camera matrix without": lambda folder: camera_file(
        folder, "K: [500, 0, 9, 0, 500, 9, 0, 0, 1]\nD: [0, 0, 0, 0]\n"
    ),
    "to the service: two cameras": lambda folder: read_cameras(
        [f"a={written(folder, 'camera.yaml', b'fov_y_deg: 60')}"] * 2, VIEW
    ),
    "to the service: another kind": lambda folder: inspect(b"BM" + bytes(100), VIEW),
    "to the service: bytes behind": lambda folder: inspect(jpeg() + bytes(100), VIEW),
    "to the service: over": lambda folder: inspect(jpeg(4000, 3000), VIEW),
    "a missing file": lambda folder: read_image(folder / "none.jpg", VIEW),
    "no film": lambda folder: read_film_header(written(folder, "a.mp4", b"no film at all")),
    "a film that breaks off": lambda folder: predict(
        halved(film(folder, "-c:v", "mpeg4", "-movflags", "faststart"))
    ),
    "a recording without pictures": lambda folder: predict(
        bag(folder, ("/info", "CameraInfo", CAMERA))
    ),
    "a recording with several cameras": lambda folder: predict(
        bag(folder, ("/left", "Image", GREY), ("/right", "Image", GREY))
    ),
    "a topic that is not there": lambda folder: predict_files(
        engine(), [str(bag(folder, ("/left", "Image", GREY)))], topic="/right"
    ),
    "a picture that holds depths": lambda folder: predict(bag(folder, ("/depth", "Image", DEPTHS))),
    "pictures that change their size": lambda folder: predict(
        bag(folder, ("/left", "Image", GREY), ("/left", "Image", LARGE))
    ),
    "a stream that cannot be opened": lambda folder: predict_files(
        engine(), ["http://127.0.0.1:9/a"]
    ),
    "a webcam that is not there": lambda folder: predict_files(engine(), ["63"]),
    "a film that shows no marked road": lambda folder: calibrated(
        folder, film(folder, "-vf", "boxblur=30", "-c:v", "mpeg4")
    ),
    "pictures without a board": lambda folder: calibrated(folder, written(folder, "a.jpg", jpeg())),
    "a lane width that no lane has": lambda folder: calibrated(
        folder, written(folder, "a.jpg", jpeg()), lane_width_m=0.3
    ),
    "a frame in a chunk": lambda folder: damaged_round(folder).select("train").image(0),
    "a label in a chunk": lambda folder: damaged_round(folder).select("train").labels,
    "a file that is no round": lambda folder: open_round(written(folder, "a.mcap", jpeg())),
    "another version of the definitions": lambda folder: Dataset.open(
        write_dataset(folder, definitions="1")
    ).select("train"),
    "a faulty row": lambda folder: labelled(folder, "2.0", 280),
    "an image of another aspect ratio": lambda folder: labelled(folder, "-2.0", 400),
    "a `?` where none may be": lambda folder: labelled(folder, "?", 280),
    "a table to import": lambda folder: import_labels(
        written(folder, "a.csv", b"file\n"), folder / "new"
    ),
    "pictures to label without their camera": pictures_without_camera,
    "handles above the horizon": lambda folder: fit_markings(
        VIEW, [[9, 9], [20, 8]], [[200, 180], [150, 120]], pitch_deg=0.0
    ),
    "a lane width for varied": lambda folder: make_road(find_track("oval"), 1, 3.5, "varied"),
    "an action or command": lambda folder: on_oval(Command(steer=1.00001)),
    "a start outside": lambda folder: on_oval(to_middle=40.0),
    "a step before the first reset": lambda folder: environment().step([0.0]),
    "a copy of an environment": lambda folder: copy.deepcopy(environment()),
    "an unknown track": lambda folder: find_track("no-such-track"),
    "a random road": lambda folder: find_track("random:x"),
    "a run that does not exist": lambda folder: resolve_run("no-such-run", folder),
    "rounds without the drives": lambda folder: drive_rows(
        Dataset.open(write_dataset(folder)).select(), folder
    ),
    "many cars with a state": lambda folder: train_actor(
        TrainConfig(folder / "run", "td3", envs=8, state="residual")
    ),
    "a folder to continue": stored_config,
    "weights of the loss": lambda folder: parse_alpha("0.3,-1,0.5"),
}
"""What makes the program refuse, by the first words of the row."""


def row(words: str) -> Callable[[Try], Try]:
    """Adds a longer attempt to `TRIES`."""

    def add(function: Try) -> Try:
        TRIES[words] = function
        return function

    return add


@row("a film in which FFmpeg")
def _(folder: Path) -> object:
    content = bytearray(film(folder, "-c:v", "libx264", "-movflags", "faststart").read_bytes())
    middle = len(content) // 2
    content[middle : middle + 1500] = np.random.default_rng(0).bytes(1500)
    return predict(written(folder, "damaged.mp4", bytes(content)))


@row("a codec without a decoder")
def _(folder: Path) -> object:
    path = film(folder, "-c:v", "libsvtav1", "-preset", "12", "-pix_fmt", "yuv420p")
    if list(Film(path).pictures()):
        pytest.skip("this build of OpenCV decodes AV1")
    return predict(path)


@row("a header that mirrors")
def _(folder: Path) -> object:
    program = pytest.importorskip("imageio_ffmpeg").get_ffmpeg_exe()
    plain, mirrored = film(folder, "-c:v", "mpeg4"), folder / "mirrored.mp4"
    command = [program, "-v", "error", "-display_hflip", "-i", plain, "-c", "copy", mirrored]
    subprocess.run(command, check=True, stderr=subprocess.DEVNULL)
    return predict(mirrored)


@row("interlaced pictures")
def _(folder: Path) -> object:
    tags = ("-vf", "tinterlace=interleave_top", "-flags", "+ilme+ildct", "-c:v", "mpeg2video")
    path = film(folder, *tags, name="a.mpg")
    try:
        shown = [
            np.mean(picture.image) for picture in Film(path).pictures() if picture.image is not None
        ]
    except UserError:
        return predict(path)
    assert min(shown) > 50
    return pytest.skip("this build of OpenCV shows interlaced pictures")


@row("a pipe or a device")
def _(folder: Path) -> object:
    os.mkfifo(folder / "a.mp4")
    return predict(folder / "a.mp4")


@row("a recording that is cut")
def _(folder: Path) -> object:
    bag = recorded.write_bag(folder / "bag", [("/left", "Image", GREY)] * 3)
    file = next(bag.glob("*.mcap"))
    file.write_bytes(file.read_bytes()[:-100])
    return predict(bag)


@row("a contact without PyBullet")
def _(folder: Path) -> object:
    with pytest.MonkeyPatch.context() as patch, World(Road(find_track("oval"))) as world:
        patch.setitem(sys.modules, "pybullet", None)
        patch.delitem(sys.modules, "simulator.world.physics", raising=False)
        world.reset(seed=0, angle=-1.2, speed=20.0)
        return [world.step(Command(gear=0)) for _ in range(40)]


@row("a picture in a process")
def _(folder: Path) -> object:
    turns = Turns(mock.Mock(), (1, 2, 2, 3), free=lambda: None)
    with mock.patch("os.getpid", return_value=0), turns:  # as a forked child finds it
        return None


@row("a bad action of one of many cars")
def _(folder: Path) -> object:
    cars = LateralControlVector(2, track="oval")
    cars.reset(seed=0)
    return cars.step([[0.0], [float("nan")]])


@row("a list with more or fewer entries than a vector has cars")
def _(folder: Path) -> object:
    return LateralControlVector(3, track=["oval", "town"])


@row("a process that draws")
def _(folder: Path) -> object:
    cars = DriverViewVector(1, track="oval")
    with mock.patch("simulator.camera.workers.pool.MODULE", "simulator.no_such_module"):
        return cars.reset(seed=0)


@row("EGL is missing")
def _(folder: Path) -> object:
    with mock.patch("moderngl.create_context", side_effect=ImportError("libEGL.so not loaded")):
        return Graphics()


@row("a TORCS track")
def _(folder: Path) -> object:
    length = '<attnum name="lg" unit="yard" val="9"/>'
    segment = f'<section name="a"><attstr name="type" val="str"/>{length}</section>'
    text = (
        '<params name="t"><section name="Header"><attnum name="version" val="4"/></section>'
        '<section name="Main Track"><attnum name="width" unit="m" val="12"/>'
        f'<section name="Track Segments">{segment}</section></section></params>'
    )
    return read_torcs(written(folder, "t.xml", text.encode()))


@pytest.mark.parametrize("row", ROWS, ids=lambda cells: cells[0][:40])
def test_each_row_is_refused_with_its_class_and_message(row: list[str], tmp_path: Path) -> None:
    words, name, message, _ = row
    (attempt,) = (made for start, made in TRIES.items() if words.startswith(start))
    with pytest.raises(UserError, match=re.escape(message)) as refused:
        attempt(tmp_path)
    assert type(refused.value).__name__ == name


def test_the_page_holds_every_case_and_no_class_that_does_not_exist() -> None:
    assert len(ROWS) == len(TRIES) > 30
    classes = error_classes()
    assert {name for _, name, _, _ in ROWS} <= set(classes)
    assert all(about for _, _, about in classes.values())
    assert "<!-- generated: errors -->" in PAGE
