"""`mtlnet calibrate`, and the cameras that `mtlnet predict` estimates itself."""

import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import Mock, patch

import cv2
import numpy as np
import pytest

from mtlnet.calibration.config import CalibrateConfig
from mtlnet.calibration.run import calibrate
from mtlnet.inference.image_decoding.decode import read_whole_image
from mtlnet.inference.rectification import Rectification
from mtlnet.predict.lenses import DriveLens, with_lens
from mtlnet.sources.films import Film
from mtlnet.sources.find import Source
from mtlnet.sources.kinds import SourceKind
from mtlnet.sources.pictures import Picture, fit
from runtime.camera_file import read_camera
from runtime.film import Mp4Writer
from tests.mtlnet.calibration.drawn import board_pictures, chessboard, road_picture
from tests.mtlnet.conftest import write_dataset
from tests.typed import error_line, typed
from trackfeatures.camera import CameraParameters
from trackfeatures.errors import UserError

MODEL = CameraParameters()
CAMERA = CameraParameters(480, 360, fov_y_deg=60.0, z=1.0, pitch_deg=2.0, yaw_deg=1.5)
MARKINGS_M = [-1.6, 1.7]


@pytest.fixture(scope="module")
def film(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Six seconds of a straight road."""
    path = tmp_path_factory.mktemp("films") / "drive.mp4"
    with Mp4Writer(path, 5.0) as made:
        for number in range(30):
            made.write(road_picture(CAMERA, [left + 0.02 * (-1) ** number for left in MARKINGS_M]))
    return path


def test_a_film_becomes_a_camera_file(film: Path, tmp_path: Path) -> None:
    out, page = tmp_path / "camera.yaml", tmp_path / "page.html"
    given = ("--fov", 60, "--lane-width", 3.3, "--out", out, "--report", page, "--json")
    done = typed("mtlnet", "calibrate", film, *given)
    assert done.returncode == 0, done.stderr
    result = json.loads(done.stdout)
    camera = read_camera(out, MODEL)
    assert (camera.width, camera.height, camera.fov_y_deg) == (480, 360, 60.0)
    assert camera.pitch_deg == pytest.approx(2.0, abs=0.15)
    assert camera.yaw_deg == pytest.approx(1.5, abs=0.15)
    assert camera.height_above_road_m == pytest.approx(1.25, rel=0.02)
    assert result["pitch_deg"] == camera.pitch_deg
    assert result["std"]["height_m"] == pytest.approx(camera.height_std * 1.25, rel=0.05)
    assert out.read_text().startswith("# mtlnet calibrate: pitch ")
    assert page.read_text().count("data:image/jpeg") == 6


def test_pictures_of_a_drive_in_a_row(tmp_path: Path) -> None:
    for number in range(15):
        cv2.imwrite(str(tmp_path / f"{number}.png"), road_picture(CAMERA, MARKINGS_M))
    config = CalibrateConfig([str(tmp_path)], tmp_path / "c.yaml", drive=True, fov_y_deg=60.0)
    result, line = calibrate(config)
    assert result["pitch_deg"] == pytest.approx(2.0, abs=0.15)
    assert "lane width 3.6 m, assumed; field of view 60 deg, given" in line


def test_of_many_pictures_some_from_the_whole_drive_are_used(tmp_path: Path) -> None:
    names = [f"{number}.png" for number in range(38)]
    for name in names:
        cv2.imwrite(str(tmp_path / name), road_picture(CAMERA, MARKINGS_M))
    page = tmp_path / "page.html"
    config = CalibrateConfig(
        [str(tmp_path)], tmp_path / "c.yaml", drive=True, fov_y_deg=60.0, page=page
    )
    read = Mock(side_effect=read_whole_image)
    with patch.multiple("mtlnet.calibration.drive", KEPT=15, read_whole_image=read):
        _, line = calibrate(config)
    assert [names.index(call.args[0].name) for call in read.call_args_list] == [
        0, 2, 5, 7, 10, 13, 15, 18, 21, 23, 26, 29, 31, 34, 37,
    ]  # fmt: skip
    assert line.endswith("; 15 of 38 pictures were used, spread evenly over the drive")
    assert "15 of 38 pictures were used" in page.read_text()


def test_a_board_becomes_a_camera_file(tmp_path: Path) -> None:
    lens = CameraParameters(400, 300, matrix=(330.0, 330.0, 200.0, 150.0))
    board_pictures(chessboard(6, 4), lens, tmp_path, 5, seed=4)
    out, page = tmp_path / "camera.yaml", tmp_path / "page.html"
    done = typed("mtlnet", "calibrate", tmp_path, "--out", out, "--report", page)
    assert done.returncode == 0, done.stderr
    assert "of 5 pictures of the board 6x4" in done.stdout
    camera = read_camera(out, MODEL)
    assert camera.focal_px == pytest.approx(330.0, rel=0.01)
    assert (camera.z, camera.distortion) == (MODEL.z, "opencv")
    assert page.read_text().count("data:image/jpeg") >= 4


def _no_markings(path: Path) -> Path:
    rng = np.random.default_rng(0)
    with Mp4Writer(path, 5.0) as made:
        for _ in range(20):
            made.write(rng.normal(110, 5, (240, 320, 3)).clip(0, 255).astype(np.uint8))
    return path


def test_what_cannot_be_calibrated_is_one_line(film: Path, tmp_path: Path) -> None:
    picture, cut = tmp_path / "one.png", tmp_path / "cut.mp4"
    cv2.imwrite(str(picture), road_picture(CAMERA, MARKINGS_M))
    cut.write_bytes(film.read_bytes()[: film.stat().st_size // 2])
    out, round_file = tmp_path / "camera.yaml", tmp_path / "r.mcap"
    data = tmp_path / "data"
    data.mkdir()
    round_file.write_bytes((write_dataset(data) / "rounds" / "r000.mcap").read_bytes())
    cases: list[tuple[list[object], str]] = [
        ([_no_markings(tmp_path / "none.mp4")], "none.mp4: "),
        ([picture], "no chessboard in 1 pictures"),
        ([picture, "--drive"], "1 of 1 pictures show both markings of a lane"),
        ([cut], "cut.mp4 cannot be opened as a film"),
        ([film, film], "give it alone"),
        ([tmp_path / "nothing.mp4"], "there is no image file"),
        ([film, "--lane-width", 36], "--lane-width 36 m; give 2 to 6 m"),
        ([film, "--fov", 0], "--fov-y-deg: "),
        ([round_file], "r.mcap is a round; give a film"),
        ([film, "--board", "9x6"], "--board and --fisheye are for pictures of a board"),
        ([picture, "--drive", "--fisheye"], "--board and --fisheye are for pictures of a board"),
        ([picture, "--fov", 60], "--lane-width are for a drive; for pictures of a drive give"),
        ([picture, "--camera", film], "--lane-width are for a drive; for pictures of a drive"),
        ([picture, "--photo", picture], "--lane-width are for a drive; for pictures of a drive"),
        ([picture, "--lane-width", 3], "--lane-width are for a drive; for pictures of a drive"),
    ]
    for given, seen in cases:
        done = typed("mtlnet", "calibrate", *given, "--out", out)
        assert done.returncode == 1, given
        assert seen in error_line(done)
        assert "Traceback" not in done.stderr
    assert not out.exists()


def test_no_file_to_read_is_replaced(tmp_path: Path) -> None:
    first, second, lens = (tmp_path / name for name in ("1.png", "2.png", "lens.yaml"))
    for picture in (first, second):
        cv2.imwrite(str(picture), road_picture(CAMERA, MARKINGS_M))
    lens.write_text("{width: 480, height: 360, fov_y_deg: 60}\n")
    before = {path: path.read_bytes() for path in (first, second, lens)}
    new, inputs = tmp_path / "new", [str(first), str(second)]
    drive = CalibrateConfig(inputs, new, drive=True, camera=lens)
    cases: list[tuple[dict[str, Any], str]] = [
        ({"out": second}, r"--out .*2\.png is a file to read; give another one"),
        ({"page": first}, r"--report .*1\.png is a file to read"),
        ({"page": lens}, r"--report .*lens\.yaml is a file to read"),
        ({"photo": first, "out": first}, r"--out .*1\.png is a file to read"),
        ({"page": new}, "--out and --report are the same file"),
    ]
    for given, seen in cases:
        with pytest.raises(UserError, match=seen):
            calibrate(replace(drive, **given))
    assert before == {path: path.read_bytes() for path in before}
    assert not new.exists()


def test_a_film_that_breaks_off_is_told_and_used(
    film: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("mtlnet.sources.films.missing_end", lambda path: "no end")
    out = tmp_path / "camera.yaml"
    config = CalibrateConfig([str(film)], out, fov_y_deg=60.0)
    with pytest.raises(UserError, match=r"it breaks off: no end.* was written from them: pitch"):
        calibrate(config)
    assert read_camera(out, MODEL).pitch_deg == pytest.approx(2.0, abs=0.15)


def test_predict_finds_the_camera_of_a_film(film: Path, tmp_path: Path) -> None:
    lines: list[str] = []
    source = Source(film, SourceKind.FILM)
    lens = with_lens(source, MODEL, 60.0, lines.append, calibrate=True).lens
    assert isinstance(lens, Rectification)
    assert lens.source.pitch_deg == pytest.approx(2.0, abs=0.15)
    assert lens.target == MODEL
    assert len(lines) == 1
    assert lines[0].startswith(f"{film}: camera found: pitch ")
    assert with_lens(source, MODEL, 60.0, lines.append).lens == 60.0  # --camera model
    none = Source(_no_markings(tmp_path / "none.mp4"), SourceKind.FILM)
    assert with_lens(none, MODEL, None, lines.append, calibrate=True).lens is None
    assert "no camera found (" in lines[1]
    assert "the model's own is assumed" in lines[1]
    assert len(lines) == 2


@pytest.mark.slow
def test_the_command_finds_it_unless_the_camera_is_the_models(film: Path) -> None:
    found = typed("mtlnet", "predict", film, "--fov-y-deg", 60, "--json")
    own = typed("mtlnet", "predict", film, "--camera", "model", "--json")
    assert (found.returncode, own.returncode) == (0, 0)
    assert re.search(r"drive\.mp4: camera found: pitch (1\.9|2\.0)", found.stderr)
    assert "camera found" not in own.stderr
    # The car points along the road, and its camera 1.5 degrees to the left of it.
    angles = [
        np.mean([row["angle_rad"] for row in json.loads(done.stdout)]) for done in (found, own)
    ]
    assert abs(angles[0]) < 0.012
    assert angles[1] - angles[0] == pytest.approx(-np.radians(1.5), abs=0.012)


def test_a_film_of_the_models_size_is_not_calibrated(tmp_path: Path) -> None:
    path, lines = tmp_path / "own.mp4", list[str]()
    with Mp4Writer(path, 5.0) as made:
        made.write(road_picture(MODEL, MARKINGS_M))
    source = with_lens(Source(path, SourceKind.FILM), MODEL, None, lines.append, calibrate=True)
    assert (source.lens, lines) == (None, [])


def test_a_stream_is_calibrated_while_it_runs() -> None:
    lines: list[str] = []
    finder = DriveLens("webcam 0", MODEL, 60.0, lines.append)
    picture = road_picture(CAMERA, MARKINGS_M)
    lenses = [finder.at(Picture(k, picture, 1e9 + 0.2 * k, bgr=True)) for k in range(80)]
    assert isinstance(lenses[74], Rectification)
    assert isinstance(lenses[75], Rectification)
    assert (lenses[74].source.fov_y_deg, lenses[74].source.pitch_deg) == (60.0, MODEL.pitch_deg)
    assert lenses[75].source.pitch_deg == pytest.approx(2.0, abs=0.15)
    assert len(lines) == 1
    own = DriveLens("webcam 0", MODEL, None, lines.append)
    wanted = road_picture(replace(MODEL, pitch_deg=3.0), MARKINGS_M)
    assert {own.at(Picture(k, wanted, 0.2 * k)) for k in range(80)} == {None}
    assert len(lines) == 1


@pytest.mark.parametrize(
    ("size", "fov_y_deg"), [((1280, 720), 43.0), ((1280, 1024), None), ((720, 1280), None)]
)
def test_a_stream_of_a_narrow_camera_is_answered_before_it_is_calibrated(
    size: tuple[int, int], fov_y_deg: float | None
) -> None:
    lines: list[str] = []
    picture = Picture(0, np.zeros((size[1], size[0], 3), np.uint8), 1e9, bgr=True)
    finder = DriveLens("webcam 0", MODEL, fov_y_deg, lines.append)
    assert fit(picture, MODEL, finder.at(picture)).shape == (210, 280, 3)
    assert lines == []
    for later_s in (15.0, 30.0):
        finder.at(replace(picture, time_s=1e9 + later_s))
    assert len(lines) == 2
    assert all("the mount of the model's camera is assumed" in line for line in lines)


def test_a_film_of_a_narrow_camera_without_markings_is_answered(tmp_path: Path) -> None:
    path = _no_markings(tmp_path / "none.mp4")
    lines: list[str] = []
    source = Source(path, SourceKind.FILM)
    lens = with_lens(source, MODEL, 60.0, lines.append, calibrate=True).lens
    assert isinstance(lens, Rectification)
    picture = next(iter(Film(path).pictures()))
    assert fit(picture, MODEL, lens).shape == (210, 280, 3)
    assert lens.source.z == MODEL.z
    assert "the mount of the model's camera is assumed" in lines[0]
