"""The index reader, with the official reader as the oracle, and its behaviour on damaged files."""

import resource
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader

from datagen.recording import Dataset, DatasetError
from datagen.recording.folder import round_path
from datagen.recording.labels import read_labels
from datagen.recording.mcap.footer import read_metadata, read_summary
from datagen.recording.mcap.index import open_round
from datagen.recording.mcap.mmap import map_file
from datagen.recording.mcap.records import CHUNK_HEAD, MESSAGE_INDEX, RECORD
from datagen.recording.schema import topics
from tests.datagen.conftest import Samples


@pytest.fixture
def path(samples: Samples, tmp_path: Path) -> Path:
    path = tmp_path / "r.mcap"
    samples.write(path, samples.header(), samples.frames(90, seed=3))
    return path


@pytest.fixture
def few_descriptors() -> Iterator[int]:
    before = resource.getrlimit(resource.RLIMIT_NOFILE)
    limit = len(list(Path("/proc/self/fd").iterdir())) + 20
    resource.setrlimit(resource.RLIMIT_NOFILE, (limit, before[1]))
    yield limit
    resource.setrlimit(resource.RLIMIT_NOFILE, before)


def test_the_summary_equals_that_of_the_official_reader(path: Path) -> None:
    view = map_file(path)
    mine = read_summary(view)
    with path.open("rb") as stream:
        reader = make_reader(stream)
        official = reader.get_summary()
        metadata = {record.name: record.metadata for record in reader.iter_metadata()}
    assert official is not None
    assert official.statistics is not None
    assert mine.channels == {c.topic: c.id for c in official.channels.values()}
    assert [(c.start, c.compression, c.indexes) for c in mine.chunks] == [
        (c.chunk_start_offset, c.compression, c.message_index_offsets)
        for c in official.chunk_indexes
    ]
    assert len(mine.chunks) > 1
    assert mine.counts == official.statistics.channel_message_counts
    assert {name: read_metadata(view, at) for name, at in mine.metadata.items()} == metadata


def test_more_rounds_can_be_open_than_file_descriptors(path: Path, few_descriptors: int) -> None:
    indexes = [open_round(path) for _ in range(few_descriptors + 100)]
    one = indexes[0].messages[topics.CAMERA].payload(7)
    assert all(index.messages[topics.CAMERA].payload(7) == one for index in indexes)


def test_a_file_is_unmapped_with_its_last_view(path: Path) -> None:
    def maps() -> int:
        return Path("/proc/self/maps").read_text().count(str(path))

    view = map_file(path)
    assert view.readonly
    array = np.frombuffer(view, np.uint8)
    del view
    assert (maps(), array.tobytes()) == (1, path.read_bytes())
    del array
    assert maps() == 0


def test_a_damaged_summary_is_refused_on_opening(path: Path) -> None:
    data = bytearray(path.read_bytes())
    data[-400] ^= 1
    path.write_bytes(data)
    with pytest.raises(DatasetError, match="its index is damaged"):
        open_round(path)


@pytest.mark.parametrize("entry", ["log_time", "place"])
def test_a_damaged_message_index_is_refused_on_reading(dataset: Path, entry: str) -> None:
    """The summary's CRC does not cover this index, so the message that it points at is checked."""
    path = round_path(dataset, "r000")
    data = bytearray(path.read_bytes())
    summary = read_summary(memoryview(bytes(data)))
    index_at = summary.chunks[0].indexes[summary.channels[topics.CAMERA]]
    entry_at = index_at + RECORD.size + MESSAGE_INDEX.size + 16 * 7
    data[entry_at + (0 if entry == "log_time" else 8)] ^= 0x01
    path.write_bytes(data)
    with pytest.raises(DatasetError):
        _read_all(dataset)


@pytest.mark.parametrize("place", ["image", "last byte", "size", "crc", "inner size"])
def test_a_flipped_byte_of_a_chunk_costs_its_frames_only(path: Path, place: str) -> None:
    good = [bytes(open_round(path).messages[topics.CAMERA].payload(i)) for i in range(90)]
    data = bytearray(path.read_bytes())
    first, second = read_summary(memoryview(bytes(data))).chunks[:2]
    at = {
        "image": first.start + CHUNK_HEAD + 5000,
        "last byte": min(first.indexes.values()) - 1,
        "size": first.start + RECORD.size + 16,
        "crc": first.start + RECORD.size + 24,
        "inner size": first.start + CHUNK_HEAD - 8,
    }[place]
    data[at] ^= 0x04
    path.unlink()
    path.write_bytes(data)
    index = open_round(path)
    camera = index.messages[topics.CAMERA]
    places = camera._table[1]  # type: ignore[attr-defined]
    bad = np.flatnonzero((places > first.start) & (places < second.start)).tolist()
    assert 10 < len(bad) < 90
    for i in bad:
        with pytest.raises(ValueError, match=rf"the chunk at byte {first.start} is damaged"):
            camera.payload(i)
    for i in set(range(90)) - set(bad):
        assert camera.payload(i) == good[i]
    with pytest.raises(DatasetError, match=r"a label is damaged \(the chunk at byte"):
        read_labels(index, 0)
    kept = np.setdiff1d(np.arange(90), [*bad, bad[-1] + 1])
    assert len(read_labels(index, 0, kept)) == len(kept)


def test_a_chunk_whose_crc_was_not_computed_is_read(path: Path) -> None:
    """A CRC of 0 means that there is none (mcap.dev/spec)."""
    data = bytearray(path.read_bytes())
    for chunk in read_summary(memoryview(bytes(data))).chunks:
        data[chunk.start + RECORD.size + 24 : chunk.start + RECORD.size + 28] = bytes(4)
    path.unlink()
    path.write_bytes(data)
    assert len(read_labels(open_round(path), 0)) == 90


def test_a_round_without_frames_is_refused(samples: Samples, tmp_path: Path) -> None:
    path = tmp_path / "empty.mcap"
    samples.write(path, samples.header(), [])
    with pytest.raises(DatasetError, match="has no frames"):
        read_labels(open_round(path), 0)


def _read_all(dataset: Path) -> None:
    frames = Dataset.open(dataset).select("all")
    _ = frames.labels
    for i in range(len(frames)):
        frames.jpeg(i)
