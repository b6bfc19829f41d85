"""Inputs of perception and datasets that are refused: images, cameras, films, recordings, labels.

`TRIES` has an attempt for each row of the page of errors, by the first words of the row.
"""

import os
import shutil
import subprocess
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import pytest
import simplejpeg

from datagen.recording import Dataset
from datagen.recording.mcap.footer import read_summary
from datagen.recording.mcap.index import open_round
from mtlnet.calibration.config import CalibrateConfig
from mtlnet.calibration.run import calibrate
from mtlnet.data.custom_images import open_custom_images
from mtlnet.data.labels_file import COLUMNS
from mtlnet.evaluation.protocol import drive_rows
from mtlnet.inference.engine import Engine, load_engine
from mtlnet.inference.image_decoding.decode import crop_and_resize, read_header, read_whole_image
from mtlnet.inference.model_card import UNCERTAINTY_WEIGHTS, WEIGHTS, read_card, resolve_run
from mtlnet.inference.rectification import Rectification
from mtlnet.inference.shipped_models import SHIPPED
from mtlnet.label.folder import LabelFolder
from mtlnet.label.geometry import fit_markings
from mtlnet.label.import_table import import_labels
from mtlnet.predict.run import predict_files
from mtlnet.sources.films import Film, read_film_header
from mtlnet.training.losses.task_weights import parse_alpha
from runtime.camera_file import read_camera
from serve.cameras import read_cameras
from tests.docs.attempts import Try, add_to, written
from tests.mtlnet.conftest import write_dataset
from tests.mtlnet.sources import recorded
from trackfeatures.camera import CameraParameters
from trackfeatures.errors import UserError

VIEW = CameraParameters()


def jpeg(width: int = 280, height: int = 210) -> bytes:
    return bytes(simplejpeg.encode_jpeg(np.full((height, width, 3), 90, np.uint8)))


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
    return crop_and_resize(read_whole_image(written(folder, "a.jpg", content)), VIEW)


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
    "to the service: another kind": lambda folder: read_header(b"BM" + bytes(100)),
    "to the service: bytes behind": lambda folder: read_header(jpeg() + bytes(100)),
    "to the service: over": lambda folder: read_header(jpeg(4000, 3000)),
    "a missing file": lambda folder: crop_and_resize(read_whole_image(folder / "none.jpg"), VIEW),
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
    "a run that does not exist": lambda folder: resolve_run("no-such-run", folder),
    "rounds without the drives": lambda folder: drive_rows(
        Dataset.open(write_dataset(folder)).select(), folder
    ),
    "weights of the loss": lambda folder: parse_alpha("0.3,-1,0.5"),
}


@add_to(TRIES, "a run without a graph")
def _(folder: Path) -> object:
    run = shutil.copytree(SHIPPED, folder / "run")
    card = read_card(run)
    files = {name: card.files[name] for name in (WEIGHTS, UNCERTAINTY_WEIGHTS)}
    replace(card, files=files).write(run)
    with mock.patch("mtlnet.inference.engine.find_spec", return_value=None):
        return load_engine(run, "openvino", "f32")


@add_to(TRIES, "a film in which FFmpeg")
def _(folder: Path) -> object:
    content = bytearray(film(folder, "-c:v", "libx264", "-movflags", "faststart").read_bytes())
    middle = len(content) // 2
    content[middle : middle + 1500] = np.random.default_rng(0).bytes(1500)
    return predict(written(folder, "damaged.mp4", bytes(content)))


@add_to(TRIES, "a codec without a decoder")
def _(folder: Path) -> object:
    path = film(folder, "-c:v", "libsvtav1", "-preset", "12", "-pix_fmt", "yuv420p")
    if list(Film(path).pictures()):
        pytest.skip("this build of OpenCV decodes AV1")
    return predict(path)


@add_to(TRIES, "a header that mirrors")
def _(folder: Path) -> object:
    program = pytest.importorskip("imageio_ffmpeg").get_ffmpeg_exe()
    plain, mirrored = film(folder, "-c:v", "mpeg4"), folder / "mirrored.mp4"
    command = [program, "-v", "error", "-display_hflip", "-i", plain, "-c", "copy", mirrored]
    subprocess.run(command, check=True, stderr=subprocess.DEVNULL)
    return predict(mirrored)


@add_to(TRIES, "interlaced pictures")
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


@add_to(TRIES, "a pipe or a device")
def _(folder: Path) -> object:
    os.mkfifo(folder / "a.mp4")
    return predict(folder / "a.mp4")


@add_to(TRIES, "a recording that is cut")
def _(folder: Path) -> object:
    bag = recorded.write_bag(folder / "bag", [("/left", "Image", GREY)] * 3)
    file = next(bag.glob("*.mcap"))
    file.write_bytes(file.read_bytes()[:-100])
    return predict(bag)
