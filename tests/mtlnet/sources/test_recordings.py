"""`mtlnet predict` on Foxglove files and ROS 2 bags, written by their official writers."""

import json
import sys
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import simplejpeg
from numpy.typing import NDArray
from rosbags.rosbag2 import CompressionMode, StoragePlugin

from mtlnet.predict.run import InputsLeftOut, predict_files
from mtlnet.sources.find import find_sources
from tests.mtlnet.predict.brightness_engine import BrightnessEngine
from tests.mtlnet.sources.recorded import (
    START_S,
    Message,
    ros_camera,
    ros_compressed,
    ros_image,
    write_bag,
    write_foxglove,
)
from tests.typed import typed
from trackfeatures.errors import UserError

COUNT = 5
DISTORTED = (0.1, 0.0, 0.0, 0.0, 0.0)
CAMERA = "/camera/image_raw"


def pictures(size: tuple[int, int] = (420, 560)) -> list[NDArray[np.uint8]]:
    rng = np.random.default_rng(0)
    return [rng.integers(0, 40 * (n + 1), (*size, 3), dtype=np.uint8) for n in range(COUNT)]


def answers(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """The parts of rows that do not depend on name and time."""
    return [
        {k: v for k, v in r.items() if k not in ("image", "time_s", "latency_ms")} for r in rows
    ]


def jpegs() -> list[bytes]:
    """The third picture is rotated: its EXIF orientation is 3."""
    exif = (
        b"\xff\xe1\x00\x22Exif\0\0MM\0*\0\0\0\x08\0\x01\x01\x12\0\x03\0\0\0\x01\0\x03\0\0\0\0\0\0"
    )
    made = [bytes(simplejpeg.encode_jpeg(image, quality=95)) for image in pictures()]
    made[2] = made[2][:2] + exif + made[2][2:]
    return made


def test_bags_and_foxglove_files_give_the_answers_of_a_folder(
    engine: BrightnessEngine, tmp_path: Path
) -> None:
    """JPEG in all kinds of recordings, one picture rotated by its EXIF."""
    folder = tmp_path / "photos"
    folder.mkdir()
    for number, data in enumerate(jpegs()):
        (folder / f"{number}.jpg").write_bytes(data)
    expected = answers(predict_files(engine, [str(folder)]))
    assert len({row["angle_rad"] for row in expected}) == COUNT
    ros = [(f"{CAMERA}/compressed", "CompressedImage", ros_compressed(data)) for data in jpegs()]
    foxglove: list[Message] = [
        ("/front", "CompressedImage", {"data": data, "format": "jpeg", "frame_id": "front"})
        for data in jpegs()
    ]
    made = [
        write_bag(tmp_path / "mcap", ros),
        write_bag(tmp_path / "sqlite", ros, StoragePlugin.SQLITE3),
        write_bag(tmp_path / "zstd", ros, StoragePlugin.MCAP, CompressionMode.MESSAGE),
        write_bag(tmp_path / "file", ros, StoragePlugin.SQLITE3, CompressionMode.FILE),
        write_foxglove(tmp_path / "protobuf.mcap", foxglove),
        write_foxglove(tmp_path / "json.mcap", foxglove, as_json=True),
    ]
    for bag, suffix in zip(made[:4], ("mcap", "db3", "mcap", "zstd"), strict=True):
        made.append(next(bag.glob(f"*.{suffix}")))  # a file of a bag
    for path in made:
        assert find_sources([str(path)])[0].count == COUNT
        rows = predict_files(engine, [str(path)])
        assert answers(rows) == expected, path
        assert [row["image"] for row in rows] == [f"{path}#{n}" for n in range(COUNT)]
        times = [row["time_s"] - START_S for row in rows]  # from the header, not the log
        assert times == pytest.approx([0.05 * n for n in range(COUNT)], abs=1e-6)


def test_one_of_several_files_of_a_compressed_bag_is_refused(
    engine: BrightnessEngine, tmp_path: Path
) -> None:
    ros = [(CAMERA, "CompressedImage", ros_compressed(data)) for data in jpegs()]
    bag = write_bag(tmp_path / "bag", ros, StoragePlugin.SQLITE3, CompressionMode.FILE)
    (file,) = bag.glob("*.zstd")
    about = bag / "metadata.yaml"
    about.write_text(about.read_text().replace(f"- {file.name}", f"- {file.name}\n  - b.db3", 1))
    message = r"is one of 2 files of a compressed bag; give the folder of the bag, .*/bag$"
    with pytest.raises(UserError, match=message):
        predict_files(engine, [str(file)])


def test_raw_pictures_give_the_answers_of_lossless_files(
    engine: BrightnessEngine, tmp_path: Path
) -> None:
    folder = tmp_path / "photos"
    folder.mkdir()
    for number, image in enumerate(pictures()):
        cv2.imwrite(str(folder / f"{number}.png"), image[..., ::-1])
    expected = answers(predict_files(engine, [str(folder)]))
    bgr = [(CAMERA, "Image", ros_image(image[..., ::-1], "bgr8", 13)) for image in pictures()]
    raw: list[Message] = [
        ("/front", "RawImage", {
            "width": 560, "height": 420, "encoding": "rgb8", "step": 1680, "data": image.tobytes(),
        })
        for image in pictures()
    ]  # fmt: skip
    for path in (
        write_bag(tmp_path / "bag", bgr, StoragePlugin.SQLITE3),
        write_foxglove(tmp_path / "raw.mcap", raw),
        write_foxglove(tmp_path / "json.mcap", raw, as_json=True),
    ):
        assert answers(predict_files(engine, [str(path)])) == expected


def test_a_topic_is_chosen_or_the_line_lists_them(engine: BrightnessEngine, tmp_path: Path) -> None:
    dark, bright = (ros_image(np.full((210, 280), level, np.uint8), "mono8") for level in (9, 200))
    camera = ros_camera((280, 210), (150, 150, 139.5, 104.5))
    messages: list[Message] = [
        ("/left", "Image", dark), ("/right", "Image", bright), ("/right", "Image", bright),
        ("/info", "CameraInfo", camera),
    ]  # fmt: skip
    bag = str(write_bag(tmp_path / "bag", messages))
    listed = r"/left \(sensor_msgs/msg/Image, 1 messages\), /right \(sensor_msgs/msg/Image, 2 mess"
    with pytest.raises(UserError, match=rf"several topics with pictures: {listed}.*--topic"):
        predict_files(engine, [bag])
    with pytest.raises(
        UserError, match=rf"no topic /middle; its topics with pictures are {listed}"
    ):
        predict_files(engine, [bag], topic="/middle")
    with pytest.raises(UserError, match=r"/info .*CameraInfo.*is not a supported picture"):
        predict_files(engine, [bag], topic="/info")
    assert len(predict_files(engine, [bag], topic="/right")) == 2
    empty = str(write_bag(tmp_path / "none", messages[3:]))
    with pytest.raises(UserError, match=r"none holds no pictures .*; its topics are /info"):
        predict_files(engine, [empty])


def test_a_cut_recording_gives_what_is_left(engine: BrightnessEngine, tmp_path: Path) -> None:
    """A recording truncated by a full disk, and by a killed program, so without its index."""
    noise = [ros_compressed(data) for data in jpegs()]
    made = write_bag(tmp_path / "bag", [(CAMERA, "CompressedImage", d) for d in noise])
    file = next(made.glob("*.mcap"))
    raw: list[Message] = [
        ("/front", "CompressedImage", {"data": data, "format": "jpeg"}) for data in jpegs()
    ]
    killed = write_foxglove(tmp_path / "killed.mcap", raw, finish=False, chunk_bytes=1 << 16)
    whole = file.read_bytes()
    table = tmp_path / "rows.jsonl"
    for path, content in ((made, whole[: len(whole) * 6 // 10]), (killed, killed.read_bytes())):
        (file if path == made else path).write_bytes(content)
        with pytest.raises(
            InputsLeftOut, match=r"is cut or damaged after \d pictures of"
        ) as raised:
            predict_files(engine, [str(path)], [table])
        rows = [json.loads(line) for line in table.read_text().splitlines()]
        assert 1 <= len(rows) == len(raised.value.results) < COUNT + 1


def test_a_cut_database_gives_what_is_left(engine: BrightnessEngine, tmp_path: Path) -> None:
    """`rosbags` and SQLite refuse it; the folder and its file give the same pictures."""
    images = [(CAMERA, "Image", ros_image(image, "rgb8")) for image in pictures((210, 280))]
    bag = write_bag(tmp_path / "bag é", images, StoragePlugin.SQLITE3)
    whole = answers(predict_files(engine, [str(bag)]))
    file = next(bag.glob("*.db3"))
    content = file.read_bytes()
    for path in (bag, file):
        file.write_bytes(content[: len(content) * 6 // 10])
        message = r"é.db3 is cut or damaged after 1 pictures of .*used .database disk image is malf"
        with pytest.raises(InputsLeftOut, match=message) as raised:
            predict_files(engine, [str(path)])
        assert answers(raised.value.results) == whole[:1]
    file.write_bytes(content[:5000])  # without its topics
    with pytest.raises(UserError, match="cannot be read as a ROS 2 bag"):
        predict_files(engine, [str(bag)])


def test_one_bad_message_costs_no_other(engine: BrightnessEngine, tmp_path: Path) -> None:
    messages = [(CAMERA, "CompressedImage", ros_compressed(data)) for data in jpegs()]
    messages[1] = (CAMERA, "CompressedImage", ros_compressed(b"no picture"))
    bag = write_bag(tmp_path / "bag", messages)
    with pytest.raises(
        InputsLeftOut, match=r"bag#1 \(/camera/image_raw\): no image file"
    ) as raised:
        predict_files(engine, [str(bag)])
    assert [row["image"][-1] for row in raised.value.results] == list("0234")


DEEP = b"[" * 100_000
BAD_JSON = [
    b'{"timestamp": {"sec": 1e400}}',
    b'{"timestamp": {"sec": 99999999999999999999}}',
    b'{"timestamp": {"nsec": 1e10}}',
    DEEP,
    b'{"timestamp": ' + DEEP,
    b'{"data": "\xff"}',
    b'{"data": "\\ud800", "format": "jpeg"}',
    b'{"data": "AAAA", "format": "\\ud800"}',
    b"[1]",
]


@pytest.mark.parametrize("bad", BAD_JSON)
def test_one_bad_json_message_costs_no_other(
    engine: BrightnessEngine, tmp_path: Path, bad: bytes
) -> None:
    good = {"data": jpegs()[0], "format": "jpeg"}
    calibration = ("/front/calibration", "CameraCalibration", bad)
    messages: list[Message] = [("/front/image", "CompressedImage", c) for c in (good, bad, good)]
    file = write_foxglove(tmp_path / "a.mcap", [calibration, *messages], as_json=True)
    notes: list[str] = []
    with pytest.raises(InputsLeftOut, match=r"a\.mcap#1 \(/front/image\): the message") as raised:
        predict_files(engine, [str(file)], note=notes.append)
    assert [row["image"][-1] for row in raised.value.results] == list("02")
    assert "/front/calibration is not used" in "".join(notes)


def test_pictures_that_change_their_size_end_the_recording(
    engine: BrightnessEngine, tmp_path: Path
) -> None:
    sizes = [(420, 560), (420, 560), (210, 280)]
    grey = [ros_image(np.full(size, 90, np.uint8), "mono8") for size in sizes]
    bag = write_bag(tmp_path / "bag", [(CAMERA, "Image", image) for image in grey])
    message = r"picture 2 is 280 x 210 px, those before it are 560 x 420 px and were used"
    with pytest.raises(InputsLeftOut, match=message) as raised:
        predict_files(engine, [str(bag)])
    assert len(raised.value.results) == 2


@pytest.mark.parametrize(
    ("storage", "count", "step_s", "fps"),
    [
        (StoragePlugin.MCAP, 5, 0.1, 10.0),
        (StoragePlugin.SQLITE3, 60, 1 / 30, 30.0),
        (StoragePlugin.MCAP, 1, 0.1, 20.0),  # unknown
        (StoragePlugin.MCAP, 3, 0.0, 20.0),
    ],
)
def test_the_drawn_film_of_a_recording_has_its_frame_rate(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    storage: StoragePlugin,
    count: int,
    step_s: float,
    fps: float,
) -> None:
    monkeypatch.setattr("tests.mtlnet.sources.recorded.STEP_NS", round(step_s * 1e9))
    grey = ros_image(np.full((21, 28), 90, np.uint8), "mono8")
    bag = write_bag(tmp_path / "bag", [(CAMERA, "Image", grey)] * count, storage)
    assert find_sources([str(bag)])[0].fps == pytest.approx(fps, rel=1e-6)


@pytest.mark.slow
def test_the_command_takes_a_topic_and_tells_of_the_camera(tmp_path: Path) -> None:
    """The darker of two cameras is chosen; standard output has only the answers."""
    dark, bright = (ros_image(np.full((210, 280), level, np.uint8), "mono8") for level in (9, 200))
    info = ros_camera((280, 210), (150, 150, 139.5, 104.5))
    messages: list[Message] = [
        ("/left/image", "Image", dark), ("/right/image", "Image", bright),
        ("/left/camera_info", "CameraInfo", info),
    ]  # fmt: skip
    bag = write_bag(tmp_path / "bag", messages)
    done = typed("mtlnet", "predict", bag, "--topic", "/left/image", "--json")
    assert done.returncode == 0, done.stderr
    (row,) = json.loads(done.stdout)
    assert (row["image"], row["time_s"]) == (f"{bag}#0", START_S)
    assert f"{bag}: matrix and distortion come from /left/camera_info" in done.stderr
    done = typed("mtlnet", "predict", bag)
    assert done.returncode == 1
    assert done.stderr.strip().splitlines()[-1].startswith(f"error: {bag} has several topics")


@pytest.mark.parametrize("kind", ["mcap", "db3", "json", "metadata.yaml"])
def test_no_damage_ends_in_a_traceback(engine: BrightnessEngine, tmp_path: Path, kind: str) -> None:
    """Flipped bits, wrong bytes and cuts anywhere: answers or a UserError."""
    small = [bytes(simplejpeg.encode_jpeg(image[:21, :28], quality=60)) for image in pictures()[:3]]
    camera = ros_camera((28, 21), (20, 20, 13.5, 10), "plumb_bob", DISTORTED)
    ros: list[Message] = [("/c/image", "CompressedImage", ros_compressed(data)) for data in small]
    ros.append(("/c/camera_info", "CameraInfo", camera))
    if kind == "json":
        plain: list[Message] = [
            ("/c", "CompressedImage", {"data": d, "format": "jpeg"}) for d in small
        ]
        target = file = write_foxglove(tmp_path / "a.mcap", plain, as_json=True)
    else:
        storage = StoragePlugin.SQLITE3 if kind == "db3" else StoragePlugin.MCAP
        target = write_bag(tmp_path / "bag", ros, storage)
        file = next(path for path in target.iterdir() if path.name.endswith(kind))
    whole = file.read_bytes()
    rng = np.random.default_rng(1)
    refused = 0
    for _ in range(20):
        content = bytearray(whole)
        at = int(rng.integers(len(content)))
        change = int(rng.integers(3))
        if change == 0:
            content[at] ^= 1 << int(rng.integers(8))
        elif change == 1:
            content[at : at + 8] = rng.bytes(8)
        else:
            del content[at:]
        file.write_bytes(content)
        try:
            predict_files(engine, [str(target)])
        except UserError:
            refused += 1
    assert refused


def test_a_file_of_the_bag_is_not_overwritten(engine: BrightnessEngine, tmp_path: Path) -> None:
    bag = write_bag(tmp_path / "bag", [(CAMERA, "CompressedImage", ros_compressed(jpegs()[0]))])
    file = next(bag.glob("*.mcap"))
    before = file.read_bytes()
    with pytest.raises(UserError, match="is a file to read; give another one"):
        predict_files(engine, [str(bag)], [file])
    assert file.read_bytes() == before


def test_a_missing_package_is_named(
    engine: BrightnessEngine, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    image: list[Message] = [(CAMERA, "CompressedImage", ros_compressed(jpegs()[0]))]
    bag = write_bag(tmp_path / "bag", image, StoragePlugin.SQLITE3)
    monkeypatch.setitem(sys.modules, "rosbags.rosbag2", None)
    needed = r"needs the package rosbags.*, in `pip install driverview\[recording\]`"
    with pytest.raises(UserError, match=needed):
        predict_files(engine, [str(bag)])
