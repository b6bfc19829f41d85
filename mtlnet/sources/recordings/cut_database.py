"""Reads a ROS 2 bag from a truncated SQLite file, as far as possible.

`rosbags` refuses a truncated file. SQLite reads it only if its check of the file's size is switched
off. Messages are read in the order in which they were written, up to the first missing page.
"""

import sqlite3
from collections.abc import Iterator
from contextlib import closing, suppress
from pathlib import Path
from urllib.parse import quote

from mtlnet.sources.recordings.topic import Topic

WITHOUT_CHECK = (
    "PRAGMA writable_schema=ON"  # disables the check of the size; the file is opened read-only
)


class CutDatabase:
    """A truncated bag. `fault`, set after the last message, states where the file ends."""

    def __init__(self, path: Path, reason: str) -> None:
        self._path, self._reason = path, reason
        self.fault = ""

    def topics(self) -> list[Topic]:
        """Return the topics of the file, also topics without messages; an empty list if their table
        is missing."""
        with suppress(sqlite3.Error), closing(self._open()) as file:
            rows = file.execute("SELECT name, type FROM topics ORDER BY name").fetchall()
            return [Topic(str(name), str(kind), "cdr") for name, kind in rows]
        return []

    def messages(self, topic: str) -> Iterator[tuple[int, bytes]]:
        used = 0
        query = (
            "SELECT timestamp, data FROM messages WHERE topic_id IN "
            "(SELECT id FROM topics WHERE name = ?) ORDER BY messages.id"
        )
        with suppress(sqlite3.Error), closing(self._open()) as file:
            for time, data in file.execute(query, (topic,)):
                yield time, data
                used += 1
        self.fault = (
            f"{self._path} is cut or damaged after {used} pictures of {topic}; these pictures "
            f"were used ({self._reason})"
        )

    def _open(self) -> sqlite3.Connection:
        name = quote(bytes(self._path.absolute()))
        # The iterator is used on the decoding thread.
        file = sqlite3.connect(
            f"file:{name}?immutable=1&mode=ro", uri=True, check_same_thread=False
        )
        file.execute(WITHOUT_CHECK)
        return file
