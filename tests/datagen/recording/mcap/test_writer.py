"""The bytes of a round: all topics, read by the official reader, and reproducible."""

import subprocess
import sys
from pathlib import Path
from typing import Any

import mcap.writer
import numpy as np
import pytest
import simplejpeg
from foxglove_schemas_protobuf.PointsAnnotation_pb2 import PointsAnnotation
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory

import trackfeatures as tf
from datagen.recording.labels import read_labels
from datagen.recording.mcap.index import MappedMessages, RoundIndex, open_round
from datagen.recording.mcap.protobuf_wire import points_field
from datagen.recording.schema import topics
from datagen.recording.schema.polylines import CORNER_PX
from tests.datagen.conftest import Samples

SCHEMAS = {
    "/camera/front": "foxglove.CompressedImage",
    "/camera/front/calibration": "foxglove.CameraCalibration",
    "/camera/front/annotations": "foxglove.ImageAnnotations",
    "/labels": "driverview.TrackFeatures",
    "/ego/state": "driverview.VehicleState",
    "/sensors": "driverview.Sensors",
    "/command": "driverview.Command",
    "/traffic": "foxglove.SceneUpdate",
    "/track/scene": "foxglove.SceneUpdate",
    "/tf": "foxglove.FrameTransforms",
}


def test_the_official_reader_finds_every_topic_at_its_rate(
    samples: Samples, tmp_path: Path
) -> None:
    path = tmp_path / "r.mcap"
    frames = samples.frames(45, seed=3)
    samples.write(path, samples.header(), frames)
    seen: dict[str, list[Any]] = {topic: [] for topic in SCHEMAS}
    with path.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True, decoder_factories=[DecoderFactory()])
        for schema, channel, message, decoded in reader.iter_decoded_messages():
            assert schema is not None
            assert schema.name == SCHEMAS[channel.topic]
            assert (message.log_time - topics.EPOCH_NS) % (topics.NANOSECONDS // 20) == 0
            seen[channel.topic].append(decoded)
        summary = reader.get_summary()
    counts = {topic: len(found) for topic, found in seen.items()}
    assert counts == {
        **dict.fromkeys(SCHEMAS, 45), "/camera/front/calibration": 3, "/track/scene": 1,
    }  # fmt: skip
    assert summary is not None
    assert all(chunk.compression == "" for chunk in summary.chunk_indexes)
    image = simplejpeg.decode_jpeg(seen["/camera/front"][7].data, "RGB")
    assert np.abs(image.astype(int) - frames[7].image).mean() < 6.0
    assert seen["/command"][0].gear == 3
    assert list(seen["/sensors"][5].range) == list(frames[5].sensors.range)
    assert len(seen["/traffic"][0].entities) == 3  # the ego car and two others
    line = seen["/camera/front/annotations"][2].points[0]
    from_corner = np.asarray(frames[2].markings[0]) + CORNER_PX
    assert np.allclose([(p.x, p.y) for p in line.points], from_corner)


def test_labels_are_exact_and_absent_ones_unset(samples: Samples, tmp_path: Path) -> None:
    path = tmp_path / "r.mcap"
    frames = samples.frames(200, seed=4)
    samples.write(path, samples.header(), frames)
    with path.open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        found = [decoded for *_, decoded in reader.iter_decoded_messages(["/labels"])]
    absent = 0
    for message, frame in zip(found, frames, strict=True):
        for name, value in frame.features.distances.items():
            field = f"to_marking_{name}"
            assert message.HasField(field) == (value is not None)
            assert value is None or getattr(message, field) == value
            absent += value is None
        assert message.HasField("to_lane_centre") == (frame.features.to_lane_centre is not None)
        assert message.angle == frame.features.angle
        assert message.heading == frame.features.heading
        assert (message.s, message.to_middle) == (frame.place.s, frame.place.to_middle)
    assert absent > 100  # the samples contain absent distances


def test_our_reader_and_the_official_one_agree(
    samples: Samples, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "r.mcap"
    samples.write(path, samples.header(), samples.frames(60, seed=5))
    fast = open_round(path)
    monkeypatch.setattr("datagen.recording.mcap.index._map_round", lambda *args: None)
    official = open_round(path)
    assert fast.summary is not None
    assert official.summary is None
    assert (fast.header, fast.result) == (official.header, official.result)
    _assert_same(fast, official)


@pytest.mark.parametrize("kind", ["zstd", "unindexed"])
def test_compressed_and_unindexed_files_are_read_with_the_official_reader(
    samples: Samples, tmp_path: Path, kind: str
) -> None:
    path, other = tmp_path / "r.mcap", tmp_path / "other.mcap"
    samples.write(path, samples.header(), samples.frames(30, seed=6))
    _rewrite(path, other, kind)
    index = open_round(other)
    assert index.summary is None
    _assert_same(index, open_round(path))


def test_the_same_round_gives_the_same_bytes_in_two_processes(
    samples: Samples, tmp_path: Path
) -> None:
    code = (
        "import pathlib, sys\n"
        "from tests.datagen.conftest import Samples\n"
        "s = Samples(); s.write(pathlib.Path(sys.argv[1]), s.header(), s.frames(25, seed=7))\n"
    )
    theirs, ours = tmp_path / "a.mcap", tmp_path / "b.mcap"
    subprocess.run([sys.executable, "-c", code, str(theirs)], check=True)
    samples.write(ours, samples.header(), samples.frames(25, seed=7))
    assert ours.read_bytes() == theirs.read_bytes()


def test_the_content_hash_covers_images_and_labels_but_not_names(
    samples: Samples, tmp_path: Path
) -> None:
    frames = samples.frames(10, seed=8)
    first = samples.write(tmp_path / "a.mcap", samples.header("r001"), frames)
    renamed = samples.write(tmp_path / "b.mcap", samples.header("r002"), frames)
    shorter = samples.write(tmp_path / "c.mcap", samples.header("r001"), frames[:-1])
    assert first.content_hash == renamed.content_hash != shorter.content_hash


def _assert_same(one: RoundIndex, other: RoundIndex) -> None:
    for topic in (topics.CAMERA, topics.LABELS, topics.EGO_STATE):
        a, b = one.messages[topic], other.messages[topic]
        assert np.array_equal(a.log_time, b.log_time)
        assert all(a.payload(i) == b.payload(i) for i in range(len(a.log_time)))
    assert isinstance(one.messages[topics.CAMERA], MappedMessages) == (one.summary is not None)
    mine, theirs = read_labels(one, 0), read_labels(other, 0)
    assert np.array_equal(mine.distances, theirs.distances, equal_nan=True)
    assert np.array_equal(mine.angle, theirs.angle)
    assert set(np.unique(mine.heading)) <= set(tf.RoadClass)


def _rewrite(source: Path, target: Path, kind: str) -> None:
    """Copy the messages to a compressed or unindexed MCAP file."""
    kinds: dict[str, dict[str, Any]] = {
        "zstd": {"compression": mcap.writer.CompressionType.ZSTD},
        "unindexed": {
            "compression": mcap.writer.CompressionType.NONE,
            "index_types": mcap.writer.IndexType.METADATA,
            "use_chunking": False,
        },
    }
    with source.open("rb") as stream, target.open("wb") as out:
        reader = make_reader(stream)
        writer = mcap.writer.Writer(out, **kinds[kind])
        writer.start()
        for record in reader.iter_metadata():
            writer.add_metadata(record.name, record.metadata)
        channels: dict[int, int] = {}
        for schema, channel, message in reader.iter_messages(log_time_order=False):
            if channel.id not in channels:
                assert schema is not None
                number = writer.register_schema(schema.name, schema.encoding, schema.data)
                channels[channel.id] = writer.register_channel(
                    channel.topic, channel.message_encoding, number
                )
            writer.add_message(
                channels[channel.id], message.log_time, message.data, message.publish_time
            )
        writer.finish()  # type: ignore[no-untyped-call]  # mcap leaves it untyped


def test_points_are_encoded_as_by_protobuf() -> None:
    points = np.array([[1.5, -2.25], [0.0, 1e9], [3.0, 0.0]])
    plain = PointsAnnotation(thickness=2.0)
    for x, y in points.tolist():
        plain.points.add(x=x, y=y)
    packed = PointsAnnotation(thickness=2.0)
    packed.MergeFromString(points_field(PointsAnnotation.POINTS_FIELD_NUMBER, points))
    assert packed == plain
    assert packed.SerializeToString() == plain.SerializeToString()
    assert points_field(3, np.zeros((0, 2))) == b""
