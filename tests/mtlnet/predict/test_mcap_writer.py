"""`mtlnet predict --out x.mcap`, read back by the official reader."""

import csv
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory

from datagen.recording.images import encode
from mtlnet.inference.rectification import Rectification
from mtlnet.predict.run import predict_files
from tests.mtlnet.predict.brightness_engine import BrightnessEngine, write_film, write_jpeg
from trackfeatures.camera import CameraParameters

EPOCH_NS = 1_577_836_800_000_000_000


def read(path: Path) -> dict[str, list[tuple[int, Any]]]:
    """Log time and content of the messages of each topic."""
    found: dict[str, list[tuple[int, Any]]] = {}
    decoder = DecoderFactory()
    with path.open("rb") as file:
        for schema, channel, message in make_reader(file, validate_crcs=True).iter_messages():
            if channel.message_encoding == "json":
                content = json.loads(message.data)
            else:
                decode = decoder.decoder_for("protobuf", schema)
                assert decode is not None
                content = decode(message.data)
            found.setdefault(channel.topic, []).append((message.log_time, content))
    return found


def test_a_film_becomes_pictures_features_and_markings(
    engine: BrightnessEngine, tmp_path: Path
) -> None:
    film = write_film(tmp_path / "film.mp4", [0, 80, 160])
    out, table = tmp_path / "out.mcap", tmp_path / "rows.csv"
    (first, *_) = predict_files(engine, [str(film), str(film)], [out, table])
    topics = read(out)
    assert {name: len(rows) for name, rows in topics.items()} == {
        "/camera/front": 6, "/camera/front/annotations": 6, "/camera/front/calibration": 1,
        "/features": 6,
    }  # fmt: skip
    with table.open(newline="") as file:
        rows = list(csv.DictReader(file))
    for (_, found), row in zip(topics["/features"], rows, strict=True):
        given = {name: value for name, value in row.items() if value}
        assert {name: str(value) for name, value in found.items()} == given
    for topic in ("/camera/front", "/camera/front/annotations", "/features"):
        steps = [time - EPOCH_NS for time, _ in topics[topic]]
        assert steps == [100_000_000 * n for n in range(6)]  # the second film follows the first
    image = topics["/camera/front"][2][1]
    shown = cv2.imdecode(np.frombuffer(image.data, np.uint8), cv2.IMREAD_COLOR)
    assert image.format == "jpeg"
    assert shown is not None
    assert shown.shape == (210, 280, 3)
    assert abs(float(shown.mean()) - 160) < 3
    marks = topics["/camera/front/annotations"][0][1]
    distances = [d for d in first["distances_m"].values() if d is not None]
    assert len(marks.points) == len(distances) == 3
    # The first at 3 m ahead, whose pixel's corner is half a pixel from its centre.
    ahead = np.array([3.0, -distances[0]])
    angle = first["angle_rad"]
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    pixel = CameraParameters().project([[*(turn @ ahead), -0.25]])[0] + 0.5
    assert (marks.points[0].points[0].x, marks.points[0].points[0].y) == pytest.approx(pixel)
    assert marks.texts[0].text.startswith("ml ")


def test_the_layout_names_the_topics_of_the_file(engine: BrightnessEngine, tmp_path: Path) -> None:
    out = tmp_path / "out.mcap"
    predict_files(engine, [str(write_jpeg(tmp_path / "a.jpg", 90))], [out])
    topics = read(out)
    layout = json.loads((tmp_path / "out.foxglove.json").read_text())
    image = layout["configById"]["Image!front"]["imageMode"]
    assert {image["imageTopic"], image["calibrationTopic"], *image["annotations"]} <= set(topics)
    with out.open("rb") as file:
        schemas = make_reader(file).get_summary().schemas.values()  # type: ignore[union-attr]
    (schema,) = [json.loads(s.data) for s in schemas if s.encoding == "jsonschema"]
    paths = [
        path["value"] for panel in layout["configById"].values() for path in panel.get("paths", [])
    ]
    assert len(paths) == 11
    for path in paths:
        topic, _, field = path.rpartition(".")
        assert topic == "/features"
        assert schema["properties"][field] == {"type": "number"}
    assert set(topics["/features"][0][1]) <= set(schema["properties"])


def test_its_pictures_are_those_of_the_given_cameras_place_and_are_read_again(
    engine: BrightnessEngine, tmp_path: Path
) -> None:
    high = replace(CameraParameters(), z=1.55)
    image, out = write_jpeg(tmp_path / "a.jpg", 90), tmp_path / "out.mcap"
    predict_files(engine, [str(image)], [out], Rectification(high, CameraParameters()))
    ((_, calibration),) = read(out)["/camera/front/calibration"]
    assert list(calibration.K) == pytest.approx(CameraParameters().intrinsics().ravel())
    notes: list[str] = []
    (again,) = predict_files(engine, [str(out)], note=notes.append)
    assert again["image"] == f"{out}#0"
    assert again["time_s"] == pytest.approx(EPOCH_NS / 1e9)
    pixels = encode(np.full((210, 280, 3), 90, np.uint8), "jpeg")
    shown = cv2.imdecode(np.frombuffer(pixels, np.uint8), cv2.IMREAD_COLOR)
    assert shown is not None
    assert again["angle_rad"] == pytest.approx(shown.mean() / 255 - 0.5, abs=1e-4)
    assert not notes  # its camera is the model's
