"""`mtlnet predict` on images, folders, patterns, films and recorded rounds."""

import csv
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

import trackfeatures as tf
from mtlnet.inference.rectification import Rectification
from mtlnet.predict.run import predict_files
from tests.mtlnet.conftest import HIGH_ROUNDS, write_dataset
from tests.mtlnet.predict.brightness_engine import BrightnessEngine, write_film, write_jpeg
from trackfeatures.camera import CameraParameters
from trackfeatures.errors import UserError


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


def test_a_round_of_a_higher_camera_is_answered_in_metres_of_its_car(
    engine: BrightnessEngine, tmp_path: Path
) -> None:
    write_dataset(tmp_path, **HIGH_ROUNDS)
    path = sorted((tmp_path / "rounds").glob("*.mcap"))[0]
    row = predict_files(engine, [str(path)])[0]
    seen = float(tf.decode(np.full((1, 6), 0.5))[0][0, 3])
    aside = 0.75 * np.sin(row["angle_rad"])
    assert row["distances_m"]["m"] == pytest.approx(1.5 * (seen - aside) + aside)


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


@pytest.mark.parametrize("fov", [0.0, -10.0, 180.0, 400.0, np.nan, np.inf])
def test_an_impossible_field_of_view_is_refused(
    tmp_path: Path, engine: BrightnessEngine, fov: float
) -> None:
    image = write_jpeg(tmp_path / "a.jpg", 90)
    with pytest.raises(UserError, match="above 0 and below 180 degrees"):
        predict_files(engine, [str(image)], lens=fov)
