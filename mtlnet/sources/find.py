"""Finds the sources that arguments name: files, folders, patterns, films, rounds, recordings of
other programs, webcams and streams."""

import os
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from mtlnet.sources.films import read_film_header
from mtlnet.sources.kinds import SourceKind, bag_metadata, kind_of
from mtlnet.sources.pictures import Lens, LensFinder
from mtlnet.sources.streams import Stream, is_live, open_stream, shown_name
from runtime.files import natural_key
from trackfeatures.errors import UserError

if TYPE_CHECKING:
    from mtlnet.sources.recordings.recording import Recording

DEFAULT_FPS = 20.0
UNREMARKABLE = ("thumbs.db", "desktop.ini", "labels.csv", "camera.yaml")
MAX_NAMED = 5
"""Maximum number of files named in a note."""

NO_TOPIC = "no input is a Foxglove file or ROS 2 bag; leave the topic out"

Note = Callable[[str], None]


@dataclass(frozen=True)
class Source:
    """A source of images: one file, recording, webcam or stream."""

    path: Path
    kind: SourceKind = SourceKind.IMAGE
    count: int = 1
    """Number of images; for a film as declared in its header; 0: unknown."""
    fps: float = DEFAULT_FPS
    problem: str = ""
    """Why no image can be read from it; empty if no problem is known."""
    address: str = ""
    """Name of a webcam, or address of a stream without the password."""
    opened: "Stream | Recording | None" = None
    lens: Lens | LensFinder = None

    @property
    def name(self) -> str:
        """Name of the source in tables and messages."""
        return self.address or str(self.path)

    @property
    def files(self) -> list[Path]:
        """The files from which the images are read, and which must not be written to."""
        is_bag = self.kind is SourceKind.RECORDING and self.path.is_dir()
        return list(self.path.iterdir()) if is_bag else [self.path]


def find_sources(
    inputs: list[str], note: Note = lambda line: None, topic: str = ""
) -> list[Source]:
    """Find the sources that `inputs` name: a file, the files of a folder or pattern, a webcam by
    its number, a stream by its address.

    The files of an input are in natural order (`frame2` before `frame10`). An input that names
    nothing becomes a source with a problem. `note` is called with a line about other files and
    subfolders of a folder, which are left out. `topic`: topic to read from recordings; empty: the
    only topic with pictures. Raises UserError for a topic if no input is a recording.
    """
    sources = [source for given in inputs for source in _find(given, note, topic)]
    if topic and not any(s.problem or s.kind is SourceKind.RECORDING for s in sources):
        raise UserError(f"topic {topic!r}: {NO_TOPIC}")
    return sources


def _find(given: str, note: Note, topic: str) -> list[Source]:
    path = Path(given)
    if not given:  # Path would take it for the current folder
        return [Source(path, problem="the name of an input is empty; give a file or a folder")]
    try:
        if is_live(given):
            return [_stream(given)]
        if path.is_dir():
            if bag_metadata(path) is not None:
                return [_source(path, SourceKind.RECORDING, topic)]
            return _in_folder(path, note, topic)
        if path.is_file():
            return [
                _source(path, kind_of(path) or SourceKind.IMAGE, topic)
            ]  # the error then describes the content
        if os.path.lexists(path):
            reason = "its target is missing" if path.is_symlink() else "a pipe or a device"
            return [Source(path, problem=f"{path} is no file ({reason}); give a file")]
        found = _in_order(p for p in _matches(path) if p.is_file())
    except (OSError, ValueError, NotImplementedError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        return [Source(path, problem=f"{given} cannot be read ({reason}); check name and mode")]
    if not found:
        return [Source(path, problem=f"there is no image file {given}, nor a film or round")]
    return _known(found, given, note, topic)


def _in_folder(folder: Path, note: Note, topic: str) -> list[Source]:
    entries = _in_order(folder.iterdir())
    files = [path for path in entries if path.is_file()]
    folders = [path for path in entries if path.is_dir() and not path.name.startswith(".")]
    if folders:
        note(f"{folder}: its folders are not searched: {_named(folders)}; give them by name")
    return _known(files, str(folder), note, topic)


def _matches(pattern: Path) -> Iterable[Path]:
    if pattern.name == "**":  # before Python 3.13 it matches folders only
        pattern /= "*"
    return Path(pattern.anchor).glob(str(pattern.relative_to(pattern.anchor)))


def _in_order(paths: Iterable[Path]) -> list[Path]:
    return sorted(paths, key=lambda path: [natural_key(part) for part in path.parts])


def _known(files: list[Path], given: str, note: Note, topic: str) -> list[Source]:
    """The sources among `files`; a note names the other files, except files that are usual in a
    folder of images."""
    kinds = {path: kind_of(path) for path in files}
    sources = [_source(path, kind, topic) for path, kind in kinds.items() if kind is not None]
    others = [path for path, kind in kinds.items() if kind is None and not _is_unremarkable(path)]
    if others:
        note(f"{given}: left out, neither image nor film nor round: {_named(others)}")
    if sources:
        return sources
    return [Source(Path(given), problem=f"there is no image in {given}, nor a film or round")]


def _is_unremarkable(path: Path) -> bool:
    return path.name.startswith(".") or path.name.lower() in UNREMARKABLE


def _named(paths: list[Path]) -> str:
    more = f" and {len(paths) - MAX_NAMED} more" if len(paths) > MAX_NAMED else ""
    return ", ".join(path.name for path in paths[:MAX_NAMED]) + more


def _stream(given: str) -> Source:
    path, name = Path(given), shown_name(given)
    try:
        opened = open_stream(given)
    except UserError as error:
        return Source(path, SourceKind.STREAM, 0, problem=str(error), address=name)
    return Source(
        path, SourceKind.STREAM, 0, opened.fps or DEFAULT_FPS, address=name, opened=opened
    )


def _source(path: Path, kind: SourceKind, topic: str) -> Source:
    try:
        if kind is SourceKind.RECORDING:
            from mtlnet.sources.recordings.recording import open_recording

            found = open_recording(path, topic)
            return Source(path, kind, found.count, found.fps() or DEFAULT_FPS, opened=found)
        if kind is SourceKind.FILM:
            header = read_film_header(path)
            return Source(path, kind, header.count, header.fps or DEFAULT_FPS)
        if kind is SourceKind.ROUND:
            from datagen.recording import open_round

            index = open_round(path)
            return Source(path, kind, index.result.frames, float(index.header.frequency_hz))
    except UserError as error:  # reported when it is read, so that other files are not lost
        return Source(path, kind, 0, problem=str(error))
    except OSError as error:
        return Source(path, kind, 0, problem=unreadable(path, error))
    except ModuleNotFoundError as error:
        needed = f"the package {error.name}, in `pip install driverview[recording]`"
        return Source(path, kind, 0, problem=f"{path} needs {needed}")
    return Source(path)


def unreadable(path: Path, error: OSError) -> str:
    """Return the text about the problem of a source that cannot be read because of `error`."""
    return f"{path} cannot be read ({error.strerror or error})"
