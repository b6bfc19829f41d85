"""Reads the messages of a recording: an MCAP file, or a ROS 2 bag of any storage.

The official reader of MCAP reads MCAP files and uncompressed bags of MCAP files, so that a
truncated file is read as far as possible. `rosbags` reads all other bags (sqlite3, compressed files
or messages).
"""

import struct
from collections.abc import Collection, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, Protocol

import zstandard
from mcap.exceptions import McapError
from mcap.reader import make_reader
from mcap.records import Channel, Message, Schema
from mcap.stream_reader import StreamReader

from mtlnet.sources.kinds import (
    BAG_METADATA,
    SQLITE_START,
    bag_metadata,
    compressed_bag_files,
)
from mtlnet.sources.recordings.cut_database import CutDatabase
from mtlnet.sources.recordings.topic import Topic
from trackfeatures.errors import UserError

# Exceptions of the readers for damaged records.
DAMAGE = (
    McapError, struct.error, zstandard.ZstdError, ValueError, EOFError, RuntimeError, LookupError,
    OverflowError, MemoryError, TypeError, AttributeError, AssertionError,
)  # fmt: skip


class Container(Protocol):
    """Interface of a recording. `fault`, set after the last message, describes what is missing;
    empty if nothing is missing."""

    fault: str

    def topics(self) -> list[Topic]:
        """Return the topics with messages, ordered by name. Raises UserError or OSError for an
        unreadable recording."""

    def messages(self, topic: str) -> Iterator[tuple[int, bytes]]:
        """Yields log time (ns since 1970) and content of each message of a topic, in order."""


def open_container(path: Path) -> Container:
    """Open the recording at `path`, a file or the folder of a bag. Raises UserError or OSError when
    it cannot be read."""
    if path.is_dir():
        about = bag_metadata(path) or {}
        if about.get("storage_identifier") != "mcap" or about.get("compression_mode"):
            return _rosbags(path, sorted(path.glob("*.db3")))
        # Before version 4 the paths started with the folder's name.
        names = [Path(str(name)).name for name in about.get("relative_file_paths", [])]
        return McapFiles(path, [path / name for name in names])
    if files := compressed_bag_files(path):
        if len(files) > 1:
            raise UserError(
                f"{path} is one of {len(files)} files of a compressed bag; give the folder of the "
                f"bag, {path.parent}"
            )
        return _rosbags(path.parent, [])
    with path.open("rb") as file:
        is_sqlite = file.read(len(SQLITE_START)) == SQLITE_START
    return _rosbags(path, [path]) if is_sqlite else McapFiles(path, [path])


def _rosbags(path: Path, databases: list[Path]) -> Container:
    bag = RosBag(path)
    try:
        bag.topics()
    except UserError as error:
        if len(databases) != 1:
            raise
        cut = CutDatabase(databases[0], str(error.__cause__).rpartition(": ")[2])
        if cut.topics():
            return cut
        raise
    return bag


class McapFiles:
    """One MCAP file, or consecutive files of a split bag."""

    def __init__(self, path: Path, files: list[Path]) -> None:
        self._path, self._files = path, files
        self.fault = ""
        self._cut: set[Path] = set()
        if not files:
            raise UserError(
                f"{path}: its {BAG_METADATA} names no files; give the .mcap files by name"
            )

    def topics(self) -> list[Topic]:
        found: dict[str, Topic] = {}
        for file in self._files:
            for topic in self._topics_of(file):
                before = found.get(topic.name)
                if before is not None and before.count is not None and topic.count is not None:
                    topic = Topic(
                        topic.name, topic.schema, topic.encoding, before.count + topic.count
                    )
                found[topic.name] = topic
        return [found[name] for name in sorted(found)]

    def messages(self, topic: str) -> Iterator[tuple[int, bytes]]:
        used = 0
        for file in self._files:
            if not file.is_file():
                self.fault = (
                    f"{self._path}: its file {file.name} is missing; all other files were used"
                )
                continue
            try:
                for time, data in self._messages_of(file, topic):
                    yield time, data
                    used += 1
            except DAMAGE as error:
                reason = " ".join(str(error).split()) or type(error).__name__
                self.fault = (
                    f"{file} is cut or damaged after {used} pictures of {topic}; these pictures "
                    f"were used ({reason})"
                )

    def _topics_of(self, file: Path) -> list[Topic]:
        try:
            with file.open("rb") as stream:
                summary = make_reader(stream).get_summary()
                if summary is not None and summary.channels and summary.statistics is not None:
                    counts = summary.statistics.channel_message_counts
                    return [
                        _topic(channel, summary.schemas, counts.get(channel.id, 0))
                        for channel in summary.channels.values()
                        if counts.get(channel.id, 0)
                    ]
        except FileNotFoundError:
            return []  # reported when its messages are read
        except DAMAGE:
            pass
        self._cut.add(file)
        return self._scan(file)

    def _scan(self, file: Path) -> list[Topic]:
        """Topics of a file without an index, as far as it can be read."""
        schemas: dict[int, Schema] = {}
        channels: dict[int, Channel] = {}
        counts: dict[int, int] = {}
        with file.open("rb") as stream, suppress(*DAMAGE):
            for record in StreamReader(stream, validate_crcs=True).records:
                if isinstance(record, Schema):
                    schemas[record.id] = record
                elif isinstance(record, Channel):
                    channels[record.id] = record
                elif isinstance(record, Message):
                    counts[record.channel_id] = counts.get(record.channel_id, 0) + 1
        if not channels:
            raise UserError(f"{file} is not an MCAP file, or ends before its first message")
        return [_topic(channels[k], schemas, count) for k, count in counts.items() if k in channels]

    def _messages_of(self, file: Path, topic: str) -> Iterator[tuple[int, bytes]]:
        with file.open("rb") as stream:
            if file not in self._cut:
                reader = make_reader(stream, validate_crcs=True)
                for _, _, message in reader.iter_messages(topics=[topic]):
                    yield message.log_time, message.data
                return
            wanted: set[int] = set()
            for record in StreamReader(stream, validate_crcs=True).records:
                if isinstance(record, Channel) and record.topic == topic:
                    wanted.add(record.id)
                elif isinstance(record, Message) and record.channel_id in wanted:
                    yield record.log_time, record.data


def _topic(channel: Channel, schemas: dict[int, Schema], count: int) -> Topic:
    schema = schemas.get(channel.schema_id)
    return Topic(channel.topic, schema.name if schema else "", channel.message_encoding, count)


class RosBag:
    """A bag of sqlite3 files or compressed files, which `rosbags` reads."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self.fault = ""
        self._topics: list[Topic] | None = None  # cached: counting messages is slow

    def topics(self) -> list[Topic]:
        if self._topics is None:
            with self._opened() as reader:
                self._topics = [
                    Topic(name, found.msgtype or "several types", "cdr", found.msgcount)
                    for name, found in sorted(reader.topics.items())
                    if found.msgcount
                ]
        return self._topics

    def messages(self, topic: str) -> Iterator[tuple[int, bytes]]:
        used = 0
        with self._opened() as reader:
            wanted = [c for c in reader.connections if c.topic == topic]
            messages = reader.messages(wanted)
            while True:
                try:
                    _, time, data = next(messages)
                except StopIteration:
                    return
                except _bag_errors() as error:
                    self.fault = (
                        f"{self._path} is cut or damaged after {used} pictures of {topic}; these "
                        f"pictures were used ({error})"
                    )
                    return
                yield time, data
                used += 1

    @contextmanager
    def _opened(self) -> Iterator[Any]:
        from rosbags.rosbag2 import Reader

        reader = Reader(self._path)
        try:
            reader.open()
        except _bag_errors() as error:
            raise UserError(
                f"{self._path} cannot be read as a ROS 2 bag: {' '.join(str(error).split())}"
            ) from error
        try:
            yield reader
        finally:
            reader.close()


def _bag_errors() -> tuple[type[Exception], ...]:
    import apsw
    from rosbags.rosbag2 import ReaderError, reader

    zstd: Any = vars(reader)["zstd"]  # Python's own module from 3.14 on, before that a package
    return (ReaderError, apsw.Error, zstd.ZstdError, OSError, *DAMAGE)


def names_of(topics: Collection[Topic]) -> str:
    """Return the topics as a list with commas, for a message; "none" if there are none."""
    return ", ".join(map(str, topics)) or "none"
