"""Finds tracks by name: the project's own tracks, then TORCS and CSV tracks in the search folders.

The folders in order: `simulator/tracks`, the given folder (`--tracks-dir`), `$TORCS_TRACKS`,
`/usr/share/games/torcs/tracks`. The first track of a name is used. `random:SEED` is not a file; see
`random_roads`.
"""

import difflib
import os
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Final

from simulator.track.errors import UnknownTrack
from simulator.track.geometry import Track, readable_name
from simulator.track.random_roads.road import is_random, random_track
from trackfeatures.errors import UserError

OWN_TRACKS: Final = Path(__file__).parent.parent / "tracks"
SYSTEM_TRACKS: Final = Path("/usr/share/games/torcs/tracks")
VARIABLE: Final = "TORCS_TRACKS"
SUFFIXES: Final = (".xml", ".toml", ".csv")


def find_track(name: str, tracks_dir: Path | None = None) -> Track:
    """Return the track called `name`: the name of a track file, `random:SEED`, or the path of a
    file (.xml, .toml or .csv).

    Raises UnknownTrack, which lists similar names, and TrackError if the file is bad.
    """
    if is_random(name):
        return random_track(name)
    path = Path(name)
    if path.suffix.lower() in SUFFIXES:
        if not path.is_file():
            raise UnknownTrack(f"there is no track file {name}; check the path")
        return read_track(path)
    files = track_files(tracks_dir)
    readable = readable_name(name)
    if readable not in files:
        raise UnknownTrack(_unknown(readable, list(files)))
    return read_track(files[readable])


def list_tracks(tracks_dir: Path | None = None) -> list[Track]:
    """Return all tracks in the search folders. A bad file is skipped with a warning on stderr."""
    tracks: list[Track] = []
    for path in track_files(tracks_dir).values():
        try:
            tracks.append(read_track(path))
        except (UserError, OSError) as error:
            _warn(f"skipped a track: {error}")
    return tracks


def read_track(path: Path) -> Track:
    """Read the track in one file; the suffix determines the format."""
    # Each format imports only its own reader: own tracks need neither XML nor scipy.
    match path.suffix.lower():
        case ".xml":
            from simulator.track.torcs.torcs import read_torcs as read
        case ".csv":
            from simulator.track.centre_line_csv import read_centre_line as read
        case _:
            from simulator.track.toml_track import read_toml_track as read
    return read(path)


def track_files(tracks_dir: Path | None = None) -> dict[str, Path]:
    """Return the path of every track's file by the track's name. If several files have one name,
    the first file in the order of the search folders is used."""
    files: dict[str, Path] = {}
    for folder in _folders(tracks_dir):
        for path in _files_in(folder):
            files.setdefault(readable_name(path.stem), path)
    return files


def _folders(tracks_dir: Path | None) -> Iterator[Path]:
    """Yield the search folders in order. Raises UserError if `tracks_dir` does not exist."""
    yield OWN_TRACKS
    if tracks_dir is not None:
        if not tracks_dir.is_dir():
            raise UserError(f"there is no folder {tracks_dir}; name one that holds track files")
        yield _tracks_below(tracks_dir)
    if from_variable := os.environ.get(VARIABLE):
        if Path(from_variable).is_dir():
            yield _tracks_below(Path(from_variable))
        else:
            _warn(f"${VARIABLE} is {from_variable}, which is no folder; unset or correct it")
    if SYSTEM_TRACKS.is_dir():
        yield SYSTEM_TRACKS


def _tracks_below(folder: Path) -> Path:
    """Return `folder`/tracks if it exists, else `folder`: TORCS has its tracks in a subfolder
    `tracks`, and users give either folder."""
    return folder / "tracks" if (folder / "tracks").is_dir() else folder


def _files_in(folder: Path) -> list[Path]:
    """Return the track files: NAME.* in the folder, and NAME/NAME.xml one and two levels below."""
    here = [path for path in folder.glob("*") if path.suffix.lower() in SUFFIXES]
    below = [*folder.glob("*/*.xml"), *folder.glob("*/*/*.xml")]
    named = [path for path in below if path.stem == path.parent.name]
    # Directories are left out, and pipes, on which a reader would wait for ever.
    return [path for path in sorted(here) + sorted(named) if path.is_file()]


def _unknown(name: str, known: list[str]) -> str:
    close = difflib.get_close_matches(name, known, n=3, cutoff=0.5)
    hint = f"did you mean {' or '.join(close)}? " if close else ""
    return (
        f"there is no track {name!r}; {hint}`simulator tracks` lists the {len(known)} known ones, "
        f"--tracks-dir or ${VARIABLE} adds a folder of TORCS tracks"
    )


def _warn(message: str) -> None:
    sys.stderr.write(f"warning: {message}\n")
