"""`mtlnet predict` on images, folders, patterns, films and recorded rounds."""

import csv
import json
import os
from dataclasses import dataclass, field, replace
from pathlib import Path
from unittest import mock

import cv2
import numpy as np
import pytest
import simplejpeg
from numpy.typing import NDArray

import trackfeatures as tf
from mtlnet.inference.model_card import ModelCard, read_card
from mtlnet.inference.rectification import Rectification
from mtlnet.predict.run import predict_files
from mtlnet.predict.writers import TEXT_HEIGHT
from mtlnet.sources.films import read_film_header
from mtlnet.sources.find import find_sources
from tests.mtlnet.conftest import HIGH_ROUNDS, write_dataset, write_round
from trackfeatures.camera import CameraParameters
from trackfeatures.errors import UserError


@dataclass
class BrightnessEngine:
    """Answers the mean colour of an image as the coded angle."""

    card: ModelCard
    kind: str = "openvino"
    precision: str = "f32"
    seen: list[tuple[int, ...]] = field(default_factory=list)

    def __call__(self, image: NDArray[np.uint8]) -> NDArray[np.float32]:
        self.seen.append(image.shape)
        level = 0.1 + 0.8 * float(image.mean()) / 255
        return np.array([0.5, 0.5, 0.5, 0.5, 0.5, level, 0.1, 0.7, 0.2], np.float32)


@pytest.fixture
def engine(published: Path) -> BrightnessEngine:
    return BrightnessEngine(read_card(published))


def write_jpeg(path: Path, level: int, size: tuple[int, int] = (210, 280)) -> Path:
    path.write_bytes(simplejpeg.encode_jpeg(np.full((*size, 3), level, np.uint8), quality=95))
    return path


def write_film(path: Path, levels: list[int]) -> Path:
    film = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), 10.0, (560, 420))
    for level in levels:
        film.write(np.full((420, 560, 3), level, np.uint8))
    film.release()
    return path


def test_images_and_films_of_another_camera(
    engine: BrightnessEngine, dataset: Path, tmp_path: Path
) -> None:
    """With half of the focal length the model's camera sees the middle half of the image."""
    image = np.zeros((420, 560, 3), np.uint8)
    image[105:315, 140:420] = 200
    wide = replace(CameraParameters(), fov_y_deg=106.36, z=1.55)
    lens = Rectification(wide, CameraParameters())
    name = str(tmp_path / "a.png")
    cv2.imwrite(name, image)
    film = write_film(tmp_path / "film.mp4", [100, 100])
    rows = predict_files(engine, [name, str(film)], [tmp_path / "all.csv"], lens)
    assert [row["image"] for row in rows] == [name, f"{film}#0", f"{film}#1"]
    assert rows[0]["angle_rad"] == pytest.approx(200 / 255 - 0.5, abs=0.01)
    # 1.8 instead of 1.2 m above the road: 1.5 times as far, apart from the camera's own position.
    angle = rows[0]["angle_rad"]
    seen = float(tf.decode(np.full((1, 6), 0.5))[0][0, 3]) - 0.75 * np.sin(angle)
    assert rows[0]["distances_m"]["m"] == pytest.approx(1.5 * seen + 0.75 * np.sin(angle))
    with (tmp_path / "all.csv").open(newline="") as file:
        assert float(next(csv.DictReader(file))["m_m"]) == rows[0]["distances_m"]["m"]
    with pytest.raises(UserError, match="has its own camera"):
        predict_files(engine, [str(next((dataset / "rounds").glob("*.mcap")))], (), lens)


def test_a_folder_and_a_pattern_name_all_their_images(
    engine: BrightnessEngine, tmp_path: Path
) -> None:
    for name, level in (("b.jpg", 50), ("a.jpg", 0), ("c.jpeg", 255)):
        write_jpeg(tmp_path / name, level)
    (tmp_path / "notes.txt").write_text("not an image")
    results = predict_files(engine, [str(tmp_path)])
    assert [Path(row["image"]).name for row in results] == ["a.jpg", "b.jpg", "c.jpeg"]
    matched = predict_files(engine, [str(tmp_path / "*.jpg")])
    assert [row["angle_rad"] for row in matched] == [row["angle_rad"] for row in results[:2]]
    assert results[0]["angle_rad"] < results[2]["angle_rad"]
    (tmp_path / "below").mkdir()
    write_jpeg(tmp_path / "below" / "d.jpg", 50)
    for pattern in ("**", "**/*"):
        whole = predict_files(engine, [str(tmp_path / pattern)])
        names = [Path(row["image"]).name for row in whole]
        assert names == ["a.jpg", "b.jpg", "d.jpg", "c.jpeg"]


def test_tables_hold_every_image(engine: BrightnessEngine, tmp_path: Path) -> None:
    images = [str(write_jpeg(tmp_path / f"{n}.jpg", 80 * n)) for n in range(3)]
    files = [tmp_path / "features.csv", tmp_path / "features.jsonl"]
    results = predict_files(engine, images, files)
    with files[0].open(newline="") as file:
        rows = list(csv.DictReader(file))
    lines = [json.loads(line) for line in files[1].read_text().splitlines()]
    assert [row["image"] for row in rows] == [line["image"] for line in lines] == images
    for row, line, result in zip(rows, lines, results, strict=True):
        assert {m: line[f"{m}_m"] for m in tf.MARKINGS} == result["distances_m"]
        assert row["ml_m"] == ("" if line["ml_m"] is None else str(line["ml_m"]))
        assert line["angle_rad"] == result["angle_rad"] == float(row["angle_rad"])
        assert row["p_straight"] == str(result["heading"]["straight"])


def test_every_frame_of_a_film_is_read_and_drawn(engine: BrightnessEngine, tmp_path: Path) -> None:
    film = write_film(tmp_path / "drive.mp4", [0, 60, 120, 180])
    drawn, reports = tmp_path / "drawn.mp4", []
    results = predict_files(
        engine, [str(film)], [drawn], report=lambda done, total: reports.append((done, total))
    )
    assert [row["image"] for row in results] == [f"{film}#{n}" for n in range(4)]
    assert engine.seen == [(210, 280, 3)] * 4
    levels = [row["angle_rad"] for row in results]
    assert levels == sorted(levels)
    assert reports == [(n, 4) for n in (1, 2, 3, 4)]
    capture = cv2.VideoCapture(str(drawn))
    assert capture.get(cv2.CAP_PROP_FPS) == pytest.approx(10)
    assert capture.get(cv2.CAP_PROP_FRAME_COUNT) == 4
    found, frame = capture.read()
    assert found
    assert frame.shape == (2 * 210 + TEXT_HEIGHT, 2 * 280 + 160, 3)


def test_a_cut_film_keeps_what_was_read(engine: BrightnessEngine, tmp_path: Path) -> None:
    whole = tmp_path / "whole.avi"
    writer = cv2.VideoWriter(str(whole), cv2.VideoWriter.fourcc(*"MJPG"), 10.0, (560, 420))
    rng = np.random.default_rng(0)
    for _ in range(10):
        writer.write(rng.integers(0, 256, (420, 560, 3), dtype=np.uint8))
    writer.release()
    cut = tmp_path / "cut.avi"
    cut.write_bytes(whole.read_bytes()[: whole.stat().st_size // 2])
    table = tmp_path / "rows.jsonl"
    with pytest.raises(
        UserError, match=r"cut\.avi ends after \d of 10 frames; those were used .it breaks"
    ):
        predict_files(engine, [str(cut)], [table])
    rows = table.read_text().splitlines()
    assert 2 <= len(rows) < 10


def test_a_film_that_cannot_be_opened_loses_no_other_file(
    engine: BrightnessEngine, tmp_path: Path
) -> None:
    broken, table = tmp_path / "broken.mp4", tmp_path / "rows.jsonl"
    broken.write_bytes(b"no film")
    film = write_film(tmp_path / "film.mp4", [10, 200])
    with pytest.raises(UserError, match=r"broken.mp4 cannot be opened as a film.*2 others"):
        predict_files(engine, [str(broken), str(film)], [table])
    assert len(table.read_text().splitlines()) == 2


def test_a_round_of_a_higher_camera_is_answered_in_metres_of_its_car(
    engine: BrightnessEngine, tmp_path: Path
) -> None:
    write_dataset(tmp_path, **HIGH_ROUNDS)
    path = sorted((tmp_path / "rounds").glob("*.mcap"))[0]
    row = predict_files(engine, [str(path)])[0]
    seen = float(tf.decode(np.full((1, 6), 0.5))[0][0, 3])
    aside = 0.75 * np.sin(row["angle_rad"])
    assert row["distances_m"]["m"] == pytest.approx(1.5 * (seen - aside) + aside)


def test_pictures_of_a_recorded_round_show_its_labels(
    engine: BrightnessEngine, dataset: Path, tmp_path: Path
) -> None:
    path = sorted((dataset / "rounds").glob("*.mcap"))[0]
    folder = tmp_path / "pictures"
    results = predict_files(engine, [str(path)], [folder])
    assert [row["image"] for row in results] == [f"{path}#{n}" for n in range(len(results))]
    pictures = sorted(folder.glob("*.png"))
    assert len(pictures) == len(results) == find_sources([str(path)])[0].count
    assert pictures[0].name == f"0000-{path.stem}-0.png"
    picture = cv2.imread(str(pictures[0]))
    assert picture is not None
    green = (picture[..., 1] > 200) & (picture[..., 0] < 130) & (picture[..., 2] < 130)
    assert green.sum() > 50, "the round's labels are drawn in green"


def test_a_damaged_image_does_not_stop_the_others(engine: BrightnessEngine, tmp_path: Path) -> None:
    write_jpeg(tmp_path / "a.jpg", 10)
    (tmp_path / "b.jpg").write_text("no image")
    write_jpeg(tmp_path / "c.jpg", 200)
    table = tmp_path / "rows.csv"
    with pytest.raises(UserError, match=r"b\.jpg: no image file.*; 2 others were done"):
        predict_files(engine, [str(tmp_path)], [table])
    assert [line.split(",")[0][-5:] for line in table.read_text().splitlines()[1:]] == [
        "a.jpg",
        "c.jpg",
    ]


def test_one_input_that_cannot_be_read_costs_no_other(
    engine: BrightnessEngine, dataset: Path, tmp_path: Path
) -> None:
    """A damaged, a truncated, a foreign and another camera's round, a missing file, a wrong
    pattern."""
    source = sorted((dataset / "rounds").glob("*.mcap"))[0]
    (tmp_path / "cut.mcap").write_bytes(source.read_bytes()[:5000])
    (tmp_path / "none.mcap").write_bytes(b"no round")
    (tmp_path / "other").mkdir()
    write_dataset(tmp_path / "other", camera=replace(CameraParameters(), z=2.0))
    bad = ["cut.mcap", "none.mcap", "missing.jpg", "*.tif", "**x", "pipe.jpg", "broken.mp4"]
    os.mkfifo(tmp_path / "pipe.jpg")
    (tmp_path / "broken.mp4").write_bytes(b"no film")
    good = write_jpeg(tmp_path / "good.jpg", 90)
    given = [*(str(tmp_path / name) for name in bad), str(good)]
    given.append(str(sorted((tmp_path / "other" / "rounds").glob("*.mcap"))[0]))
    table = tmp_path / "rows.csv"
    notes: list[str] = []
    with pytest.raises(UserError, match=r"cut\.mcap is damaged .* \(and 7 more\); 1 others were"):
        predict_files(engine, given, [table], note=notes.append)
    with table.open(newline="") as file:
        assert [row["image"] for row in csv.DictReader(file)] == [str(good)]
    assert len(notes) == len(bad)  # the other camera is found when the round is read
    assert "there is no image file" in notes[2]


def test_a_damaged_chunk_of_a_round_costs_its_frames_only(
    engine: BrightnessEngine, tmp_path: Path
) -> None:
    (tmp_path / "rounds").mkdir()
    for number in range(2):  # each is one chunk of 24 frames
        write_round(tmp_path, f"r00{number}", number)
    bad, good = sorted((tmp_path / "rounds").glob("*.mcap"))
    content = bytearray(bad.read_bytes())
    content[len(content) // 2] ^= 1
    bad.write_bytes(content)
    table = tmp_path / "rows.jsonl"
    message = rf"image 0 of .*{bad.name} cannot be read: the chunk at byte \d+ is damaged"
    with pytest.raises(UserError, match=rf"{message}.*and 23 more\); 24 others were done"):
        predict_files(engine, [str(bad), str(good)], [table])
    rows = [json.loads(line) for line in table.read_text().splitlines()]
    assert [row["image"] for row in rows] == [f"{good}#{n}" for n in range(24)]


def test_a_folder_gives_all_that_is_read_and_names_the_rest(
    engine: BrightnessEngine, tmp_path: Path
) -> None:
    for number in (1, 2, 10, 11):
        write_jpeg(tmp_path / f"frame{number}.JPG", 10 * number)
    write_film(tmp_path / "frame3.mp4", [50, 60])
    write_film(tmp_path / "frame4.mp4", [50]).rename(tmp_path / "frame4.bin")
    for name in ("a.heic", "b.txt", "labels.csv", "camera.yaml", "Thumbs.db", ".hidden"):
        (tmp_path / name).write_text("?")
    (tmp_path / "more").mkdir()
    notes: list[str] = []
    results = predict_files(engine, [str(tmp_path)], note=notes.append)
    names = [Path(row["image"]).name for row in results]
    films = ["frame3.mp4#0", "frame3.mp4#1", "frame4.bin#0"]
    assert names == ["frame1.JPG", "frame2.JPG", *films, "frame10.JPG", "frame11.JPG"]
    assert notes == [
        f"{tmp_path}: its folders are not searched: more; give them by name",
        f"{tmp_path}: left out, neither image nor film nor round: a.heic, b.txt",
    ]
    matched = predict_files(engine, [str(tmp_path / "frame*.JPG")])
    assert [Path(row["image"]).name for row in matched] == [n for n in names if n.endswith("JPG")]


def test_a_name_of_any_bytes_is_read_and_written(engine: BrightnessEngine, tmp_path: Path) -> None:
    folder = tmp_path / os.fsdecode(b"caf\xe9 [x] %d\n:")
    folder.mkdir()
    image = write_jpeg(folder / os.fsdecode(b"\xff#1.jpg"), 90)
    long = write_jpeg(folder / f"{'l' * 251}.jpg", 90)
    film = write_film(tmp_path / "film.mp4", [50, 60]).rename(folder / os.fsdecode(b"-a:b\xe9.mp4"))
    outputs = [folder / os.fsdecode(b"\xe9" + end) for end in (b".csv", b".jsonl", b".mp4", b"")]
    names = [str(image), str(long), f"{film}#0", f"{film}#1"]
    results = predict_files(engine, [str(image), str(long), str(film)], outputs)
    assert [row["image"] for row in results] == names
    lines = outputs[1].read_text(encoding="utf-8").splitlines()
    assert [json.loads(line)["image"] for line in lines] == names
    with outputs[0].open(newline="", encoding="utf-8") as file:
        rows = [row["image"] for row in csv.DictReader(file)]
    assert rows == [name.encode(errors="backslashreplace").decode() for name in names]
    assert read_film_header(outputs[2]).count == 4
    pictures = sorted(path.name for path in outputs[3].iterdir())
    assert pictures == [
        os.fsdecode(b"0000-\xff#1.png"),
        f"0001-{'l' * 200}.png",
        os.fsdecode(b"0002--a:b\xe9-0.png"),
        os.fsdecode(b"0003--a:b\xe9-1.png"),
    ]


def test_a_full_disk_keeps_what_is_done_and_is_told(
    engine: BrightnessEngine, tmp_path: Path
) -> None:
    image = write_jpeg(tmp_path / "a.jpg", 10)
    for name in ("rows.csv", "rows.jsonl"):
        (tmp_path / name).symlink_to("/dev/full")
        with pytest.raises(OSError, match="No space left") as raised:
            predict_files(engine, [str(image)], [tmp_path / name])
        assert raised.value.filename == str(tmp_path / name)


def test_nothing_is_written_after_an_error(engine: BrightnessEngine, tmp_path: Path) -> None:
    """Answers are written on another thread while the next ones are computed."""
    film = write_film(tmp_path / "in.mp4", [30] * 60)
    with (
        mock.patch("mtlnet.predict.writers.draw_prediction", side_effect=OSError("no more")),
        pytest.raises(OSError, match="no more"),
    ):
        predict_files(engine, [str(film)], [tmp_path / "out.mp4", tmp_path / "rows.csv"])
    assert not (tmp_path / "rows.csv").read_text()
    assert len(engine.seen) < 60


def test_an_interrupted_film_is_playable(engine: BrightnessEngine, tmp_path: Path) -> None:
    film, drawn = write_film(tmp_path / "in.mp4", [30] * 8), tmp_path / "out.mp4"

    def interrupt(done: int, total: int) -> None:
        if done == 5:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        predict_files(engine, [str(film)], [drawn], report=interrupt)
    assert cv2.VideoCapture(str(drawn)).get(cv2.CAP_PROP_FRAME_COUNT) == 4


def test_a_wider_lens_is_cropped_to_the_models_view(
    engine: BrightnessEngine, tmp_path: Path
) -> None:
    image = np.zeros((420, 560, 3), np.uint8)
    image[105:315, 140:420] = 255  # shown by half the tangent of the field of view
    path = tmp_path / "wide.png"
    cv2.imwrite(str(path), image)
    camera: CameraParameters = engine.card.camera
    wide = float(np.degrees(2 * np.arctan(2 * np.tan(np.radians(camera.fov_y_deg) / 2))))
    own, cropped = (predict_files(engine, [str(path)], lens=fov)[0] for fov in (None, wide))
    assert cropped["angle_rad"] > own["angle_rad"]


@pytest.mark.parametrize("fov", [0.0, -10.0, 180.0, 400.0, np.nan, np.inf])
def test_an_impossible_field_of_view_is_refused(
    tmp_path: Path, engine: BrightnessEngine, fov: float
) -> None:
    image = write_jpeg(tmp_path / "a.jpg", 90)
    with pytest.raises(UserError, match="above 0 and below 180 degrees"):
        predict_files(engine, [str(image)], lens=fov)


@pytest.mark.parametrize(
    ("inputs", "outputs", "message"),
    [
        (["none.jpg"], [], "there is no image file none.jpg"),
        ([""], [], "the name of an input is empty"),
        (["*.gif"], [], "there is no image file"),
        (["a.jpg"], ["x.txt"], r"x\.txt: give a file ending in \.csv, \.jsonl, \.mp4"),
        (["a.jpg"], ["none/x.csv"], "there is no folder"),
    ],
)
def test_wrong_inputs_and_outputs_are_refused(
    engine: BrightnessEngine,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    inputs: list[str],
    outputs: list[str],
    message: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    write_jpeg(tmp_path / "a.jpg", 10)
    with pytest.raises(UserError, match=message):
        predict_files(engine, inputs, [Path(name) for name in outputs])


def test_a_file_to_read_is_not_overwritten(tmp_path: Path, engine: BrightnessEngine) -> None:
    film = write_film(tmp_path / "film.mp4", [10, 200])
    before = film.read_bytes()
    (tmp_path / "link").symlink_to(tmp_path)
    for out in (film, tmp_path / "link" / "film.mp4"):
        with pytest.raises(UserError, match=r"film.mp4 is a file to read; give another one"):
            predict_files(engine, [str(film)], [out])
    assert film.read_bytes() == before
