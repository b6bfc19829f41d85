"""The files of `mtlnet predict`: tables, films and pictures, also when writing fails."""

import csv
import errno
import json
import os
from pathlib import Path
from unittest import mock

import cv2
import pytest
from mcap.reader import make_reader

import trackfeatures as tf
from mtlnet.predict import run
from mtlnet.predict.run import InputsLeftOut, predict_files
from mtlnet.predict.writers import TEXT_HEIGHT
from mtlnet.sources.films import read_film_header
from mtlnet.sources.find import find_sources
from tests.mtlnet.predict.brightness_engine import BrightnessEngine, write_film, write_jpeg
from trackfeatures.errors import UserError


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


def test_a_full_disk_leaves_no_broken_picture(engine: BrightnessEngine, tmp_path: Path) -> None:
    image, folder = write_jpeg(tmp_path / "a.jpg", 10), tmp_path / "drawn.2026"
    folder.mkdir()  # a folder may have a dot in its name
    full = OSError(errno.ENOSPC, "No space left on device")
    with (
        mock.patch("pathlib.Path.replace", side_effect=full),
        pytest.raises(OSError, match="No space") as raised,
    ):
        predict_files(engine, [str(image)], [folder])
    assert str(folder) in str(raised.value.filename)
    assert not list(folder.iterdir())
    predict_files(engine, [str(image)], [folder])
    assert [path.name for path in folder.iterdir()] == ["0000-a.png"]


def test_a_result_that_is_cut_is_announced(
    engine: BrightnessEngine, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(run, "KEPT_ROWS", 3)
    film, notes = str(write_film(tmp_path / "in.mp4", [30] * 5)), list[str]()
    assert len(predict_files(engine, [film], note=notes.append)) == 3
    assert "5 images done, the result has the first 3; --out has all" in notes
    notes.clear()
    predict_files(engine, [film], [tmp_path / "rows.csv"], note=notes.append)
    assert not any("the first 3" in line for line in notes)


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


def test_interrupted_files_are_complete(engine: BrightnessEngine, tmp_path: Path) -> None:
    film = write_film(tmp_path / "in.mp4", [30] * 8)
    drawn, recorded = tmp_path / "out.mp4", tmp_path / "out.mcap"

    def interrupt(done: int, total: int) -> None:
        if done == 5:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        predict_files(engine, [str(film)], [drawn, recorded], report=interrupt)
    assert cv2.VideoCapture(str(drawn)).get(cv2.CAP_PROP_FRAME_COUNT) == 4
    with recorded.open("rb") as file:
        messages = make_reader(file, validate_crcs=True).iter_messages(["/features"])
        assert len(list(messages)) == 4


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


@pytest.mark.parametrize("again", ["d.csv", "./d.csv", "link/d.csv"])
def test_a_file_is_not_written_twice(
    engine: BrightnessEngine, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, again: str
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("link").symlink_to(tmp_path)
    Path("d.csv").write_text("kept")
    image = write_jpeg(Path("a.jpg"), 10)
    with pytest.raises(UserError, match=r"--out .*d\.csv is given twice"):
        predict_files(engine, [str(image)], [Path("d.csv"), Path("d.jsonl"), Path(again)])
    assert Path("d.csv").read_text() == "kept"


def test_a_file_to_read_is_not_overwritten(tmp_path: Path, engine: BrightnessEngine) -> None:
    film = write_film(tmp_path / "film.mp4", [10, 200])
    before = film.read_bytes()
    (tmp_path / "link").symlink_to(tmp_path)
    for out in (film, tmp_path / "link" / "film.mp4"):
        with pytest.raises(UserError, match=r"film.mp4 is a file to read; give another one"):
            predict_files(engine, [str(film)], [out])
    assert film.read_bytes() == before


@pytest.mark.parametrize("link", [False, True])
def test_a_picture_to_read_is_not_replaced_by_a_drawn_one(
    tmp_path: Path, engine: BrightnessEngine, link: bool
) -> None:
    first = write_jpeg(tmp_path / "b.png", 10)
    second = write_jpeg(tmp_path / ("c.png" if link else "0000-b.png"), 200)
    if link:
        (tmp_path / "0000-b.png").symlink_to(second)
    before = second.read_bytes()
    with pytest.raises(UserError, match=r"0000-b\.png is a file to read, .* give another folder"):
        predict_files(engine, [str(first), str(second)], [tmp_path])
    assert second.read_bytes() == before
    assert engine.seen == []


def test_pictures_are_drawn_into_the_folder_of_their_images(
    tmp_path: Path, engine: BrightnessEngine
) -> None:
    image = write_jpeg(tmp_path / "a.jpg", 10)
    before = image.read_bytes()
    predict_files(engine, [str(image)], [tmp_path])
    assert sorted(path.name for path in tmp_path.iterdir()) == ["0000-a.png", "a.jpg"]
    empty = tmp_path / "empty"
    empty.mkdir()
    with pytest.raises(InputsLeftOut, match="there is no image in"):
        predict_files(engine, [str(empty), str(image)], [empty])
    assert [path.name for path in empty.iterdir()] == ["0000-a.png"]
    assert image.read_bytes() == before


def test_the_labels_of_the_pictures_are_not_overwritten(
    tmp_path: Path, engine: BrightnessEngine
) -> None:
    image, labels = write_jpeg(tmp_path / "a.jpg", 10), tmp_path / "labels.csv"
    labels.write_text("file,ml,mr\n")
    with pytest.raises(UserError, match="holds the labels of the pictures"):
        predict_files(engine, [str(image)], [labels])
    assert labels.read_text() == "file,ml,mr\n"


def test_a_damaged_input_is_not_overwritten(tmp_path: Path, engine: BrightnessEngine) -> None:
    film = tmp_path / "cut.mp4"
    film.write_bytes(b"\0\0\0\x18ftypmp42")
    image = write_jpeg(tmp_path / "a.jpg", 10)
    with pytest.raises(UserError, match=r"cut\.mp4 is a file to read"):
        predict_files(engine, [str(film), str(image)], [film])
    assert film.read_bytes() == b"\0\0\0\x18ftypmp42"
