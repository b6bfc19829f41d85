"""`from mtlnet import load`: the answers of the commands, from Python."""

import json
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from mtlnet import Features, Model, load
from mtlnet.cli import app
from mtlnet.inference.golden_image import golden_image
from mtlnet.inference.image_decoding.errors import ImageError
from mtlnet.inference.prediction import decode_outputs
from mtlnet.inference.rectification import Rectification
from runtime.camera_file import write_camera
from runtime.film import Mp4Writer
from trackfeatures.camera import CameraParameters
from trackfeatures.errors import UserError

MODEL_CAMERA = CameraParameters()


@pytest.fixture(scope="module")
def model() -> Model:
    return load("default", precision="f32")


@pytest.fixture(scope="module")
def road() -> np.ndarray:
    return golden_image(280, 210)


def test_importing_mtlnet_loads_neither_numpy_nor_torch() -> None:
    code = "import sys, mtlnet; print([m for m in ('numpy', 'torch', 'cv2') if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "[]\n"
    with pytest.raises(ImportError, match="nothing"):
        exec("from mtlnet import nothing")


def test_one_image_as_pixels_bytes_and_file_has_the_engine_s_answer(
    model: Model, road: np.ndarray, tmp_path: Path
) -> None:
    path = tmp_path / "road.png"
    png = cv2.imencode(".png", road[..., ::-1])[1].tobytes()
    path.write_bytes(png)
    true = decode_outputs(model._engine(road))
    answers = [model.predict(road), model.predict(png), model.predict(path), model(str(path))]
    assert [found.as_json() for found in answers] == [true.as_json()] * 4
    assert [found.name for found in answers] == ["", "", str(path), str(path)]
    listed = model.predict([road, png, path])
    assert [found.as_json() for found in listed] == [true.as_json()] * 3
    assert model.predict([]) == []
    assert answers[0].road_class == "straight"
    assert answers[0].to_lane_centre_m == pytest.approx(0.0, abs=0.05)


def test_a_film_is_answered_frame_by_frame_as_by_the_command(
    model: Model, road: np.ndarray, tmp_path: Path
) -> None:
    film = tmp_path / "drive.mp4"
    with Mp4Writer(film, 20.0) as writer:
        for number in range(5):
            writer.write(np.roll(road, 3 * number, axis=1))
    answers = model.predict(film)
    assert isinstance(answers, Iterator)
    found = list(answers)
    words = ["predict", str(film), "--precision", "f32", "--json"]
    rows = json.loads(CliRunner().invoke(app, words).stdout)
    assert [(f.name, f.time_s) for f in found] == [(r["image"], r["time_s"]) for r in rows]
    assert [f.as_json() for f in found] == [{k: r[k] for k in found[0].as_json()} for r in rows]


def test_a_camera_file_gives_metres_beside_that_camera(
    model: Model, road: np.ndarray, tmp_path: Path
) -> None:
    """The same picture from 1.05 times the height: all distances are 1.05 times as large."""
    high = CameraParameters(z=1.05 * 1.2 - 0.25)
    write_camera(tmp_path / "high.yaml", high)
    plain = model.predict(road)
    answers = (model.predict(road, camera=c) for c in (high, tmp_path / "high.yaml"))
    for found in answers:
        assert found.distances_m["ml"] == pytest.approx(
            1.05 * (plain.distances_m["ml"] or 0), abs=1e-3
        )
        assert found.camera == high
    with pytest.raises(UserError, match="leave fov_y_deg out"):
        model.predict(road, camera=high, fov_y_deg=50.0)


def test_markings_are_drawn_on_the_picture_in_its_own_size_and_lens(model: Model) -> None:
    """For a wide picture, a distorted camera and the model's view, orange pixels lie on the
    expected line."""
    bent = CameraParameters(
        640, 480, 70.0, pitch_deg=4.0, distortion="opencv", coefficients=(-0.2, 0.05, 0.0, 0.0)
    )
    seen = Rectification(MODEL_CAMERA, bent).image(golden_image(280, 210))
    for picture, camera in ((golden_image(1280, 960), None), (seen, bent)):
        features = model.predict(picture, camera=camera)
        drawn = features.draw(picture)
        assert drawn.shape == picture.shape
        changed = np.argwhere((drawn != picture).any(axis=2))[:, ::-1]
        own = features.camera.resized(picture.shape[1], picture.shape[0])
        ahead, left = own.road_points(changed).T
        right_of_car = -left * np.cos(features.angle_rad) + ahead * np.sin(features.angle_rad)
        distances = [d for d in features.distances_m.values() if d is not None]
        off = np.abs(right_of_car[:, None] - np.array(distances)).min(axis=1)
        assert len(changed) > 500
        assert np.median(off) < 0.05
        assert features.draw().shape == (484, 720, 3)


def test_a_field_of_view_is_that_of_the_drawing_too(model: Model) -> None:
    """With a wider lens, the model's view of it shows the same drawing as the model's own
    picture."""
    road = golden_image(1120, 840)
    wide = np.full((1680, 2240, 3), 128, np.uint8)
    wide[420:1260, 560:1680] = road
    wide_deg = float(np.degrees(2 * np.arctan(2 * np.tan(np.radians(67.5 / 2)))))
    own, seen = model.predict(road), model.predict(wide, fov_y_deg=wide_deg)
    assert (own.draw() == seen.draw()).all()
    inner = seen.draw(wide)[420:1260, 560:1680]
    drawn = (inner != road).any(axis=2), (own.draw(road) != road).any(axis=2)
    assert drawn[0].sum() > 500
    assert (drawn[0] & drawn[1]).sum() > 0.9 * drawn[1].sum()  # lines are twice as thick


def test_a_source_of_another_type_is_refused(model: Model, road: np.ndarray) -> None:
    png = cv2.imencode(".png", road[..., ::-1])[1].tobytes()
    one, *others = (model.predict(kind(png)) for kind in (bytes, bytearray, memoryview))
    assert [found.as_json() for found in others] == [one.as_json()] * 2
    wrong = [None, 0, [1], [None], {"a": 1}.values(), [[road]], np.uint8(3)]
    for source in wrong:
        with pytest.raises(UserError, match=r"of type \w+; give a file, .* or a list of images"):
            model.predict(source)  # type: ignore[arg-type]
    for camera in (5, road):
        with pytest.raises(UserError, match="give a camera file or CameraParameters"):
            model.predict(road, camera=camera)  # type: ignore[call-overload]
    for views in ("2", 3):
        with pytest.raises(UserError, match=f"--views {views!r}: give 1, 2 or 6"):
            load("default", views=views)  # type: ignore[arg-type]


def test_an_option_that_does_not_apply_is_refused(
    model: Model, road: np.ndarray, dataset: Path, tmp_path: Path
) -> None:
    cv2.imwrite(str(tmp_path / "a.png"), road)
    for source in (road, [road], tmp_path / "a.png", tmp_path):
        with pytest.raises(UserError, match="topic '/x': no input is a Foxglove file or ROS 2 bag"):
            model.predict(source, topic="/x")
    with pytest.raises(UserError, match=r"there is no image file .*none\.mcap"):
        model.predict(tmp_path / "none.mcap", topic="/x")
    answers = model.predict(dataset / "rounds" / "r000.mcap", fov_y_deg=20.0)
    with pytest.raises(UserError, match="--fov-y-deg are for images and films; a round has its"):
        next(answers)


def test_a_field_of_view_can_be_a_number_of_numpy(model: Model) -> None:
    wide = np.full((840, 1120, 3), 90, np.uint8)
    found = model.predict(wide, fov_y_deg=np.float32(90))  # type: ignore[call-overload]
    assert found.camera.fov_y_deg == 90.0
    assert found.as_json() == model.predict(wide, fov_y_deg=90).as_json()
    with pytest.raises(UserError, match="fov_y_deg is '90'; give degrees"):
        model.predict(wide, fov_y_deg="90")  # type: ignore[call-overload]


def test_faulty_sources_are_one_clear_error(model: Model, tmp_path: Path) -> None:
    with pytest.raises(UserError, match="float64 of shape"):
        model.predict(np.zeros((210, 280, 3)))  # type: ignore[arg-type]
    with pytest.raises(UserError, match=r"shape \(210, 280\)"):
        model.predict(np.zeros((210, 280), np.uint8))
    with pytest.raises(ImageError, match="no image file"):
        model.predict(b"text")
    with pytest.raises(ImageError, match="a wider image is cropped"):
        model.predict(np.zeros((280, 210, 3), np.uint8))
    with pytest.raises(UserError, match=r"there is no image file .*none\.jpg"):
        model.predict(tmp_path / "none.jpg")
    for degrees in (0.0, 180.0, float("nan")):
        with pytest.raises(UserError, match="fov_y_deg is"):
            model.predict(np.zeros((210, 280, 3), np.uint8), fov_y_deg=degrees)
    with pytest.raises(UserError, match="there is no engine 'tpu'"):
        load("default", engine="tpu")


def test_a_folder_gives_all_that_can_be_read_then_the_error(
    model: Model, road: np.ndarray, tmp_path: Path
) -> None:
    for number in (10, 2):
        cv2.imwrite(str(tmp_path / f"frame{number}.png"), road)
    (tmp_path / "frame1.jpg").write_bytes(b"\xff\xd8\xff")
    answers = model.predict(tmp_path)
    found: list[Features] = []
    with pytest.raises(UserError, match=r"frame1\.jpg"):
        found.extend(answers)
    names = []
    for features in model.predict(str(tmp_path / "*.png")):
        names.append(Path(features.name).name)
    assert names == ["frame2.png", "frame10.png"]
    one = model.predict(str(tmp_path / "*2.png"))  # a pattern of one file is not a single image
    assert [Path(features.name).name for features in one] == ["frame2.png"]


def test_evaluation_and_export_are_those_of_the_commands(
    dataset: Path, published: Path, tmp_path: Path
) -> None:
    model = load(published, precision="f32")
    words = ["evaluate", "--model", str(published), "--data", str(dataset), "--precision", "f32"]
    told = json.loads(CliRunner().invoke(app, [*words, "--json"]).stdout)
    assert model.evaluate(dataset)["errors"] == told["errors"]
    averaged = json.loads(CliRunner().invoke(app, [*words, "--views", "2", "--json"]).stdout)
    assert (told["views"], averaged["views"]) == (1, 2)
    assert (
        load(published, precision="f32", views=2).evaluate(dataset)["errors"]
        == (averaged["errors"])
    )
    assert averaged["errors"] != told["errors"]
    result = model.export("onnx", data=dataset, out=tmp_path / "onnx", frames=4)
    assert (tmp_path / "onnx" / "model.onnx").is_file()
    assert result["check"]["frames"] == 4


CONVERT = """
import os, sys
from pathlib import Path
forks = []
sys.addaudithook(lambda event, _: forks.append(event) if event == "os.fork" else None)
from mtlnet.model.network import Network
from mtlnet.model.openvino_graph import write_graph
write_graph(Network(), Path("model.xml"), Path("model.bin"))
import nncf
assert not forks, forks
"""


def test_converting_a_model_starts_no_process_and_leaves_nothing_in_the_home(
    tmp_path: Path,
) -> None:
    home = tmp_path / "home"
    home.mkdir()
    command = [sys.executable, "-c", CONVERT]
    environment = os.environ | {"HOME": str(home)}
    environment.pop("CI", None)
    subprocess.run(command, env=environment, cwd=tmp_path, check=True, timeout=120)
    assert not (home / "intel").exists()  # where OpenVINO's usage statistics keep their user's id
