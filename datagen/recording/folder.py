"""The files of a dataset folder, and how a finished round is moved into it.

A round is written under `.partial/`, read back, checked, hashed, synced and renamed into `rounds/`;
`state/ID.json` then holds its hashes. `manifest.py` derives all other files of the folder from the
files in `rounds/` and `state/`.
"""

import json
import shutil
from collections.abc import Collection, Iterable
from contextlib import suppress
from dataclasses import asdict, dataclass
from importlib.resources import files
from pathlib import Path

from datagen.recording.errors import DatasetError
from datagen.recording.round_metadata import RoundHeader, RoundResult
from datagen.recording.schema.json_schema import SCHEMA_FILE, schema_text
from runtime.files import atomic_move, atomic_write, file_hash, unfinished_path
from trackfeatures.names import require_name

PARTIAL = ".partial"
LOCKS = ".locks"
MERGING = ".merging"  # file that exists while a merge copies rounds
SUBFOLDERS = ("rounds", "state", "splits", "layouts", "proto", "schemas")
PUBLISHED_FILES = ("proto/driverview.proto", "layouts/foxglove.json", SCHEMA_FILE)


@dataclass(frozen=True, slots=True)
class RoundState:
    """Size and hashes of a finished round file, with which later changes of the file are
    detected."""

    id: str
    file: str
    bytes: int
    sha256: str
    frames: int
    content_hash: str
    definitions: str

    @staticmethod
    def of(path: Path, header: RoundHeader, result: RoundResult) -> "RoundState":
        """Compute the state of the complete round file at `path` from the file, its `header` and
        its `result`. The file can still be outside `rounds/`."""
        return RoundState(
            id=header.id,
            file=f"rounds/{header.id}.mcap",
            bytes=path.stat().st_size,
            sha256=file_hash(path),
            frames=result.frames,
            content_hash=result.content_hash,
            definitions=header.definitions,
        )

    @staticmethod
    def read(path: Path) -> "RoundState":
        """Read a file of `state/`. Raises DatasetError if it is no valid round state."""
        try:
            state = RoundState(**json.loads(path.read_text()))
            name = require_name(state.id, "round id")
            if state.file != f"rounds/{name}.mcap":
                raise ValueError(f"its file is {state.file!r}, expected rounds/{name}.mcap")
            return state
        except (ValueError, TypeError) as error:
            raise DatasetError(f"{path} is no round state: {error}") from error


def prepare(folder: Path) -> None:
    """Create the subfolders of a dataset and write the files that describe its messages."""
    for name in SUBFOLDERS:
        (folder / name).mkdir(parents=True, exist_ok=True)
    package = files("datagen.recording.schema")
    for name in PUBLISHED_FILES:
        text = schema_text() if name == SCHEMA_FILE else package.joinpath(name).read_text()
        write_if_changed(folder / name, text)


def is_unstarted(folder: Path, first_file: str) -> bool:
    """Return whether `folder` holds nothing but empty subfolders of a dataset, locks and an
    unfinished copy of `first_file`, the file that a collection writes first.

    A collection leaves a folder in this state if the disk is full from the start.
    """
    return all(
        path.name in (unfinished_path(folder / first_file).name, LOCKS)
        or (path.name in (*SUBFOLDERS, PARTIAL) and path.is_dir() and not any(path.iterdir()))
        for path in folder.iterdir()
    )


def begin_merge(folder: Path, added: Collection[str]) -> None:
    """Mark the dataset as being merged: the rounds with the ids `added` are added, and its split
    does not list them yet. The rounds of an interrupted merge stay in the mark."""
    ids = sorted({*added, *merging_rounds(folder)})
    atomic_write(folder / MERGING, json.dumps(ids), fsync=True)


def merging_rounds(folder: Path) -> list[str]:
    """Return the ids of the rounds that a merge adds, also an interrupted one; empty if there is
    none. The mark of an earlier version has no ids: then all finished rounds are returned."""
    try:
        return [str(each) for each in json.loads((folder / MERGING).read_text())]
    except FileNotFoundError:
        return []
    except (ValueError, TypeError):
        return list(read_states(folder))


def end_merge(folder: Path) -> None:
    """Remove the mark of `begin_merge`, because the split lists all rounds now."""
    (folder / MERGING).unlink(missing_ok=True)


def require_merged(folder: Path) -> None:
    """Raise DatasetError if a merge into the dataset has not ended."""
    if (folder / MERGING).exists():
        raise DatasetError(
            f"a merge into {folder} was interrupted, or is under way; end it by running the same "
            "`datagen merge` again"
        )


def round_path(folder: Path, round_id: str) -> Path:
    """Return the path of the file of a finished round. Raises BadName if the id cannot be a file
    name."""
    return folder / "rounds" / f"{require_name(round_id, 'round id')}.mcap"


def state_path(folder: Path, round_id: str) -> Path:
    """Return the path of the file with the hashes of a finished round. Raises BadName if the id
    cannot be a file name."""
    return folder / "state" / f"{require_name(round_id, 'round id')}.json"


def _partial_home(folder: Path, round_id: str) -> Path:
    """The folder of an unfinished round. Raises BadName, or DatasetError for a link.

    Its content is deleted, so it must lie within the dataset.
    """
    home = folder / PARTIAL / require_name(round_id, "round id")
    if home.parent.is_symlink():
        raise DatasetError(f"{home.parent} is a link; remove it: unfinished rounds are deleted")
    return home


def partial_path(folder: Path, round_id: str) -> Path:
    """Create an empty folder for an unfinished round; return the path of `round.mcap` in it."""
    home = _partial_home(folder, round_id)
    shutil.rmtree(home, ignore_errors=True)
    home.mkdir(parents=True)
    return home / "round.mcap"


def publish(folder: Path, partial: Path, state: RoundState) -> None:
    """Move the checked round file `partial` into `rounds/`, then write its state. After a power cut
    in between, the round has no state and counts as unfinished."""
    atomic_move(partial, round_path(folder, state.id))
    write_state(folder, state)
    discard_partial(folder, state.id)


def write_state(folder: Path, state: RoundState) -> None:
    """Write the state of a round and wait until it is on the disk (fsync)."""
    write_if_changed(state_path(folder, state.id), json.dumps(asdict(state), indent=1) + "\n")


def discard_partial(folder: Path, round_id: str) -> None:
    """Remove an unfinished round. `.partial/` stays: another process may be about to use it."""
    shutil.rmtree(_partial_home(folder, round_id), ignore_errors=True)


def discard_partials(folder: Path, round_ids: Iterable[str]) -> None:
    """Remove the unfinished files of the rounds with the ids `round_ids` that a crash or an
    interruption has left."""
    for round_id in round_ids:
        discard_partial(folder, round_id)
    with suppress(OSError):  # the folder is missing, or other rounds are being written
        (folder / PARTIAL).rmdir()


def read_states(folder: Path) -> dict[str, RoundState]:
    """Read the states of the finished rounds, and return them by id. A round is left out if its
    file is missing or has another size."""
    states = {}
    for path in sorted((folder / "state").glob("*.json")):
        state = RoundState.read(path)
        file = folder / state.file
        if file.is_file() and file.stat().st_size == state.bytes:
            states[state.id] = state
    return states


def write_if_changed(path: Path, text: str) -> None:
    """Replace a small file atomically and sync it; a file that already holds `text` is kept."""
    if not (path.is_file() and path.read_bytes() == text.encode()):
        atomic_write(path, text, fsync=True)
